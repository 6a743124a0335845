{{/* The Detectors of the values as {"detectors": […]}, with one Detector for each region of a Detector with regions. In its
spec, {region} is replaced by the name of the region. */}}
{{- define "wayside.detectors" -}}
{{- $found := list -}}
{{- range $d := .Values.detectors -}}
{{- if not $d.regions -}}{{- $found = append $found $d -}}{{- end -}}
{{- $streams := dict -}}
{{- range $region := $d.regions -}}
{{- $own := deepCopy (omit $d "regions") -}}
{{- $_ := set $own "spec" (mergeOverwrite $own.spec (deepCopy (default dict $region.spec))) -}}
{{- $own = $own | toJson | replace "{region}" $region.name | fromJson -}}
{{- $_ := set $own "name" (printf "%s-%s" $d.name $region.name) -}}
{{- $seen := $own.spec.streams | toJson -}}
{{- with get $streams $seen -}}
{{- fail (printf "detectors: %s: the regions %s and %s have the same streams, so both would see every vehicle: write {region} into the keys of spec.streams, and give each region a name of its own" $d.name . $region.name) -}}
{{- end -}}
{{- $_ := set $streams $seen $region.name -}}
{{- $found = append $found $own -}}
{{- end -}}
{{- end -}}
{{- dict "detectors" $found | toJson -}}
{{- end -}}

{{/* The spec of a Detector of the values: if it has no mode and run is not false, the mode is Standalone.
The argument is a list: the root and the Detector. */}}
{{- define "wayside.detectorSpec" -}}
{{- $root := index . 0 -}}{{- $d := index . 1 -}}
{{- $spec := deepCopy $d.spec -}}
{{- if and (not (hasKey $spec "mode")) (ne (toString $d.run) "false") -}}{{- $_ := set $spec "mode" "Standalone" -}}{{- end -}}
{{- if and $spec.mode (not $root.Values.manager.detectors.run) -}}
{{- fail (printf "detectors: %s is of mode %s, but manager.detectors.run is false: set that, or give the Detector run: false and no mode" $d.name $spec.mode) -}}
{{- end -}}
{{- toYaml $spec -}}
{{- end -}}

{{/* The namespace of an object of the values; the manager must manage it. The argument is a list: the root, the
kind and the object. */}}
{{- define "wayside.lookedAfter" -}}
{{- $root := index . 0 -}}{{- $object := index . 2 -}}
{{- $namespace := default $root.Release.Namespace $object.namespace -}}
{{- $list := ternary "namespaces" "grant" (not (empty $root.Values.manager.namespaces)) -}}
{{- $namespaces := default (list $root.Release.Namespace) (index $root.Values.manager $list) -}}
{{- if not (has $namespace $namespaces) -}}
{{- fail (printf "%s %s is in namespace %s, which the manager does not manage: add it to manager.%s, or give it the namespace of one of them (%s)" (index $ 1) $object.name $namespace $list (join ", " $namespaces)) -}}
{{- end -}}
{{- $namespace -}}
{{- end -}}

{{/* The labels of the pods of the detector of this name, which the manager runs. */}}
{{- define "wayside.detectorSelector" -}}
app.kubernetes.io/managed-by: application-manager
wayside.dev/runs: {{ . }}
{{- end -}}

{{/* The variables of OpenTelemetry by name, such as the endpoint of traces. */}}
{{- define "wayside.tracing" -}}
{{- $variables := deepCopy .Values.tracing.variables -}}
{{- with .Values.tracing.endpoint -}}{{- $_ := set $variables "OTEL_EXPORTER_OTLP_ENDPOINT" . -}}{{- end -}}
{{- $variables | toJson -}}
{{- end -}}
