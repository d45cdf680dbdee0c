{{/* The chart's name, at most 63 characters, as a label takes. */}}
{{- define "fiber-operator.name" -}}
{{- default .Chart.Name .Values.nameOverride | trunc 63 | trimSuffix "-" -}}
{{- end -}}

{{/*
What every object of the release is called, or begins with. 44 characters leave room for the longest
suffix, and a name that the release already carries is not repeated. A release may be called fiber.v1 or 1st; a
Service may not: it takes no dot and begins with a letter.
*/}}
{{- define "fiber-operator.fullname" -}}
{{- $name := include "fiber-operator.name" . -}}
{{- $full := printf "%s-%s" .Release.Name $name -}}
{{- if .Values.fullnameOverride -}}
{{- $full = .Values.fullnameOverride -}}
{{- else if contains $name .Release.Name -}}
{{- $full = .Release.Name -}}
{{- end -}}
{{- $full = replace "." "-" $full -}}
{{- if regexMatch "^[0-9]" $full -}}
{{- $full = printf "fiber-%s" $full -}}
{{- end -}}
{{- $full | trunc 44 | trimSuffix "-" -}}
{{- end -}}

{{/* Cluster-wide names carry the namespace too: the same release may exist in another one. */}}
{{- define "fiber-operator.clusterName" -}}
{{- printf "%s:%s" .Release.Namespace (include "fiber-operator.fullname" .) -}}
{{- end -}}

{{/* As the operator calls the Lease of its release: no pool's Lease has a dot in its name. */}}
{{- define "fiber-operator.leaseName" -}}
{{- printf "%s.operator.fiber.dev" (include "fiber-operator.fullname" .) -}}
{{- end -}}

{{- define "fiber-operator.serviceAccountName" -}}
{{- if .Values.serviceAccount.create -}}
{{- default (include "fiber-operator.fullname" .) .Values.serviceAccount.name -}}
{{- else -}}
{{- .Values.serviceAccount.name -}}
{{- end -}}
{{- end -}}

{{/* What selects the operator's pod; it can never change, since a Deployment's selector cannot. */}}
{{- define "fiber-operator.selectorLabels" -}}
app.kubernetes.io/name: {{ include "fiber-operator.name" . | quote }}
app.kubernetes.io/instance: {{ .Release.Name | quote }}
app.kubernetes.io/component: operator
{{- end -}}

{{/*
Called with the chart's context, a component ("" for the release as a whole) and labels of the user's. Where keys
meet, the chart's own win, so that no object carries a label twice.
*/}}
{{- define "fiber-operator.labels" -}}
{{- $root := index . 0 -}}
{{- $component := index . 1 -}}
{{- $extra := index . 2 -}}
{{- $labels := dict
  "helm.sh/chart" (printf "%s-%s" $root.Chart.Name $root.Chart.Version | replace "+" "_" | trunc 63 | trimSuffix "-")
  "app.kubernetes.io/name" (include "fiber-operator.name" $root)
  "app.kubernetes.io/instance" $root.Release.Name
  "app.kubernetes.io/version" $root.Chart.AppVersion
  "app.kubernetes.io/part-of" "fiber"
  "app.kubernetes.io/managed-by" $root.Release.Service
-}}
{{- if $component -}}
{{- $_ := set $labels "app.kubernetes.io/component" $component -}}
{{- end -}}
{{- toYaml (mergeOverwrite dict (default dict $extra) (default dict $root.Values.commonLabels) $labels) -}}
{{- end -}}

{{/* The image of workers: its repository is beside the operator's by default. */}}
{{- define "fiber-operator.workerImage" -}}
{{- $folder := trimSuffix (base .Values.image.repository) .Values.image.repository -}}
{{- $repository := default (printf "%sfiber-worker" $folder) .Values.workerImage.repository -}}
{{- include "fiber-operator.image" (list (set (deepCopy .Values.workerImage) "repository" $repository) .Chart) -}}
{{- end -}}

{{/* Called with the image's values and the chart: a digest wins over a tag, a tag over appVersion. */}}
{{- define "fiber-operator.image" -}}
{{- $image := index . 0 -}}
{{- $chart := index . 1 -}}
{{- if $image.digest -}}
{{- printf "%s@%s" $image.repository $image.digest -}}
{{- else -}}
{{- printf "%s:%s" $image.repository (default $chart.AppVersion $image.tag) -}}
{{- end -}}
{{- end -}}
