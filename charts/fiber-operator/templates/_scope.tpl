{{/*
The switch. The namespaces that the operator watches, as a JSON list; an empty one means all.
Rights (roles.yaml, users.yaml), settings (deployment.yaml) and the helm test follow this and nothing else.
*/}}
{{- define "fiber-operator.namespaces" -}}
{{- if eq .Values.scope "namespaced" -}}
{{- default (list .Release.Namespace) .Values.namespaces | toJson -}}
{{- else -}}
[]
{{- end -}}
{{- end -}}

{{/* A namespace that is watched: where the helm test makes its pool, and the notes theirs. */}}
{{- define "fiber-operator.someNamespace" -}}
{{- $namespaces := include "fiber-operator.namespaces" . | fromJsonArray -}}
{{- if or (empty $namespaces) (has .Release.Namespace $namespaces) -}}
{{- .Release.Namespace -}}
{{- else -}}
{{- first $namespaces -}}
{{- end -}}
{{- end -}}
