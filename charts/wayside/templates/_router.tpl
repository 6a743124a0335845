{{/* The router's configuration, as JSON. Flows are named from the router's view: incoming messages are ingress. */}}
{{- define "wayside.routerConfiguration" -}}
{{- $r := .Values.router -}}
{{- $endpoint := printf "%s/0.0.0.0:7447" (ternary "tls" "tcp" $r.tls.enabled) -}}
{{- $configuration := dict "mode" "router" "listen" (dict "endpoints" (list $endpoint)) -}}
{{- $_ := set $configuration "scouting" (dict "multicast" (dict "enabled" false) "gossip" (dict "enabled" false)) -}}
{{- $_ := set $configuration "adminspace" (dict "enabled" false) -}}
{{- if $r.tls.enabled -}}
{{- $tls := dict "listen_certificate" "/tls/tls.crt" "listen_private_key" "/tls/tls.key" "enable_mtls" $r.tls.mutual "close_link_on_expiration" true -}}
{{- if $r.tls.mutual -}}{{- $_ := set $tls "root_ca_certificate" "/tls/ca.crt" -}}{{- end -}}
{{- $_ := set $configuration "transport" (dict "link" (dict "tls" $tls)) -}}
{{- end -}}
{{- if $r.accessControl.enabled -}}
{{- if not (and $r.tls.enabled $r.tls.mutual) -}}
{{- fail "router.accessControl knows clients by their certificates: set router.tls.enabled and router.tls.mutual, or router.accessControl.enabled to false" -}}
{{- end -}}
{{- $rules := list -}}{{- $subjects := list -}}{{- $policies := list -}}
{{- $clients := list -}}
{{- range $client := $r.accessControl.clients -}}
{{- if contains "{commonName}" (toJson (omit $client "name" "commonNames")) -}}
{{- range $own := $client.commonNames -}}
{{- if not (regexMatch "^[A-Za-z0-9._:-]+$" $own) -}}
{{- fail (printf "router.accessControl.clients: the common name %q of %s cannot stand in a key in place of {commonName}: use letters, digits and . _ : -" $own $client.name) -}}
{{- end -}}
{{- $one := dict "name" (printf "%s-%s" $client.name $own) "commonNames" (list $own) -}}
{{- range $way := list "publish" "subscribe" "ask" "answer" -}}
{{- $keys := list -}}
{{- range $key := default list (get $client $way) -}}{{- $keys = append $keys (replace "{commonName}" $own $key) -}}{{- end -}}
{{- $_ := set $one $way $keys -}}
{{- end -}}
{{- $clients = append $clients $one -}}
{{- end -}}
{{- else -}}
{{- $clients = append $clients $client -}}
{{- end -}}
{{- end -}}
{{- range $client := $clients -}}
{{- $allowed := list -}}
{{- $ways := list
  (list "publish" "ingress" (list "put" "delete" "liveliness_token"))
  (list "publish" "egress" (list "declare_subscriber" "declare_liveliness_subscriber" "liveliness_query"))
  (list "subscribe" "ingress" (list "declare_subscriber" "declare_liveliness_subscriber" "liveliness_query"))
  (list "subscribe" "egress" (list "put" "delete" "liveliness_token"))
  (list "ask" "ingress" (list "query"))
  (list "ask" "egress" (list "reply" "declare_queryable"))
  (list "answer" "ingress" (list "reply" "declare_queryable"))
  (list "answer" "egress" (list "query")) -}}
{{- range $ways -}}
{{- $keys := get $client (index . 0) -}}
{{- if $keys -}}
{{- $id := printf "%s-%s-%s" $client.name (index . 0) (index . 1) -}}
{{- $rules = append $rules (dict "id" $id "permission" "allow" "flows" (list (index . 1)) "messages" (index . 2) "key_exprs" $keys) -}}
{{- $allowed = append $allowed $id -}}
{{- end -}}
{{- end -}}
{{- $subjects = append $subjects (dict "id" $client.name "cert_common_names" $client.commonNames) -}}
{{- if $allowed -}}{{- $policies = append $policies (dict "rules" $allowed "subjects" (list $client.name)) -}}{{- end -}}
{{- end -}}
{{- $_ := set $configuration "access_control" (dict "enabled" true "default_permission" "deny" "rules" $rules "subjects" $subjects "policies" $policies) -}}
{{- end -}}
{{- $configuration | toJson -}}
{{- end -}}
