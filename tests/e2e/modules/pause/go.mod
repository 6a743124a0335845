// The program of a pod's sandbox: it holds the pod's namespaces and does nothing.
module wayside.dev/tests/pause

go 1.26.0
