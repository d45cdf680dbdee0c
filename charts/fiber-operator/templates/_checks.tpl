{{/*
Values that are each right but contradict each other. values.schema.json refuses what is wrong by itself. All
contradictions are told at once, each with what, why and what to do.
*/}}
{{- define "fiber-operator.check" -}}
{{- $faults := list -}}
{{- with .Values -}}

{{- if and (eq .scope "cluster") .namespaces -}}
{{- $faults = append $faults (printf "namespaces is set (%s), but scope is cluster: the operator would watch every namespace all the same. Set scope=namespaced, or leave namespaces empty." (join ", " .namespaces)) -}}
{{- end -}}

{{- if and (not .serviceAccount.create) (empty .serviceAccount.name) -}}
{{- $faults = append $faults "serviceAccount.create is false and serviceAccount.name is empty: the operator's rights would go to the namespace's default ServiceAccount, and so to every pod there. Set serviceAccount.name to the one that you made, or let the chart create one." -}}
{{- end -}}

{{- if and (not .serviceAccount.create) .serviceAccount.annotations -}}
{{- $faults = append $faults "serviceAccount.annotations is set, but serviceAccount.create is false: the chart does not touch a ServiceAccount that it did not create. Annotate it yourself, or set serviceAccount.create=true." -}}
{{- end -}}

{{- if and .metrics.serviceMonitor.create (not .metrics.service.create) -}}
{{- $faults = append $faults "metrics.serviceMonitor.create is true, but metrics.service.create is false: a ServiceMonitor finds the operator through its Service, and would find nothing. Set metrics.service.create=true, or metrics.serviceMonitor.create=false." -}}
{{- end -}}

{{- with .metrics.serviceMonitor -}}
{{- if gt (int .timeoutSeconds) (int .intervalSeconds) -}}
{{- $faults = append $faults (printf "metrics.serviceMonitor.timeoutSeconds is %v, but intervalSeconds is %v: Prometheus refuses to wait for an answer until after it has asked again. Lower the one or raise the other." .timeoutSeconds .intervalSeconds) -}}
{{- end -}}
{{- end -}}

{{- if and .metrics.prometheusRule.create (not .metrics.serviceMonitor.create) -}}
{{- $faults = append $faults "metrics.prometheusRule.create is true, but metrics.serviceMonitor.create is false: the alerts look for metrics under the labels that the ServiceMonitor gives them, and FiberOperatorDown would never stop. Set metrics.serviceMonitor.create=true, or metrics.prometheusRule.create=false." -}}
{{- end -}}

{{- if and (not .networkPolicy.create) (or .networkPolicy.metricsFrom .networkPolicy.apiServer.cidrs) -}}
{{- $faults = append $faults "networkPolicy.metricsFrom or networkPolicy.apiServer.cidrs is set, but networkPolicy.create is false: nothing would be restricted. Set networkPolicy.create=true, or leave them empty." -}}
{{- end -}}

{{- range $value, $labels := dict "commonLabels" .commonLabels "podLabels" .podLabels "metrics.serviceMonitor.labels" .metrics.serviceMonitor.labels "metrics.prometheusRule.labels" .metrics.prometheusRule.labels "metrics.dashboard.labels" .metrics.dashboard.labels -}}
{{- range $label, $_ := $labels -}}
{{- if or (hasPrefix "app.kubernetes.io/" $label) (hasPrefix "helm.sh/" $label) -}}
{{- $faults = append $faults (printf "%s sets %s: the chart sets that label itself, and finds the operator's pod by such labels. Use a label of your own; nameOverride changes app.kubernetes.io/name." $value $label) -}}
{{- end -}}
{{- end -}}
{{- end -}}

{{- range .extraEnv -}}
{{- if hasPrefix "FIBER_OPERATOR_" .name -}}
{{- $faults = append $faults (printf "extraEnv sets %s: the chart derives the operator's settings from scope, operator and metrics, and rights and probes must agree with them. Set the value that stands for it instead." .name) -}}
{{- end -}}
{{- end -}}

{{- end -}}
{{- if $faults -}}
{{- fail (printf "these values contradict each other:\n  - %s" (join "\n  - " $faults)) -}}
{{- end -}}
{{- end -}}
