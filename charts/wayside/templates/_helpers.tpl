{{- define "wayside.name" -}}
{{- default .Chart.Name .Values.nameOverride | trunc 63 | trimSuffix "-" -}}
{{- end -}}

{{/* The prefix of all names, short enough for their suffixes. */}}
{{- define "wayside.fullname" -}}
{{- default .Release.Name .Values.fullnameOverride | trunc 40 | trimSuffix "-" -}}
{{- end -}}

{{- define "wayside.selector" -}}
app.kubernetes.io/name: {{ include "wayside.name" . }}
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end -}}

{{- define "wayside.labels" -}}
{{ include "wayside.selector" . }}
app.kubernetes.io/part-of: wayside
app.kubernetes.io/managed-by: {{ .Release.Service }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
helm.sh/chart: {{ printf "%s-%s" .Chart.Name .Chart.Version | replace "+" "_" }}
{{- with .Values.commonLabels }}
{{ toYaml . }}
{{- end }}
{{- end -}}

{{/* Labels of pods: without the chart's version, because a new version would restart each pod. */}}
{{- define "wayside.podLabels" -}}
{{ include "wayside.selector" . }}
app.kubernetes.io/part-of: wayside
{{- with .Values.commonLabels }}
{{ toYaml . }}
{{- end }}
{{- end -}}

{{- define "wayside.managerAccount" -}}
{{- if .Values.manager.serviceAccount.name -}}
{{ .Values.manager.serviceAccount.name }}
{{- else if .Values.manager.serviceAccount.create -}}
{{ include "wayside.fullname" . }}-manager
{{- else -}}
{{ fail "manager.serviceAccount.name is empty, and create is false: name the account that the manager runs with" }}
{{- end -}}
{{- end -}}

{{/* The reference of an image with repository, tag and digest, with the registry of all images as prefix. */}}
{{- define "wayside.image" -}}
{{- $repository := .image.repository -}}
{{- with .Values.imageRegistry -}}{{- $repository = printf "%s/%s" (trimSuffix "/" .) $repository -}}{{- end -}}
{{- if .image.digest -}}{{ $repository }}@{{ .image.digest }}{{- else -}}{{ $repository }}:{{ .image.tag }}{{- end -}}
{{- end -}}

{{- define "wayside.ownImage" -}}
{{- include "wayside.image" (dict "Values" .Values "image" (dict "repository" .Values.image.repository "digest" .Values.image.digest "tag" (default .Chart.AppVersion .Values.image.tag))) -}}
{{- end -}}

{{/* The program's identity: the holder of its Lease, which it reacquires after a restart of the container. */}}
{{- define "wayside.podEnvironment" -}}
- name: POD_NAME
  valueFrom: {fieldRef: {fieldPath: metadata.name}}
- name: POD_UID
  valueFrom: {fieldRef: {fieldPath: metadata.uid}}
- name: POD_NAMESPACE
  valueFrom: {fieldRef: {fieldPath: metadata.namespace}}
{{- end -}}

{{- define "wayside.probes" -}}
{{- range $name, $path := dict "startup" "/healthz" "readiness" "/readyz" "liveness" "/healthz" }}
{{ $name }}Probe:
  httpGet: {path: {{ $path }}, port: metrics{{ if $.Values.manager.metrics.tlsSecretName }}, scheme: HTTPS{{ end }}}
  {{- with index $.Values.manager.probes $name }}
  {{- toYaml . | nindent 2 }}
  {{- end }}
{{- end }}
{{- end -}}

{{- define "wayside.webhookSecret" -}}
{{- if eq .Values.webhook.certificates.from "Secret" -}}
{{ required "webhook.certificates.secretName is empty: name the Secret with tls.crt, tls.key and ca.crt" .Values.webhook.certificates.secretName }}
{{- else -}}
{{ include "wayside.fullname" . }}-webhook-{{ ternary "certificates" "tls" (eq .Values.webhook.certificates.from "Manager") }}
{{- end -}}
{{- end -}}

{{- define "wayside.routerSecret" -}}
{{- if .Values.router.tls.secretName -}}
{{ .Values.router.tls.secretName }}
{{- else if .Values.router.tls.issuerRef -}}
{{ include "wayside.fullname" . }}-router-tls
{{- else -}}
{{ fail "router.tls needs a certificate: give router.tls.secretName (tls.crt, tls.key, ca.crt) or router.tls.issuerRef, or set router.tls.enabled to false for a trial" }}
{{- end -}}
{{- end -}}

{{- define "wayside.kind" -}}
{{- if kindIs "map" . -}}{{ .kind }}{{- else -}}{{ . }}{{- end -}}
{{- end -}}
