{{/*
Checks of values that are valid but contradict each other. values.schema.json refuses invalid values. All
contradictions are reported at once: what, why, and what to do.
*/}}
{{- define "fiber-operator.check" -}}
{{- $faults := list -}}
{{- if empty .Values.image.repository -}}
{{- fail (printf "image.repository is empty: this chart, %s, is that of a development build, and no registry has its images. Install the chart of a release. Or build the images with `make images`, push them to a registry that the nodes reach, and set image.repository=REGISTRY/fiber-operator. On the cluster of `make cluster`, whose nodes have them, set image.repository=fiber-operator." .Chart.Version) -}}
{{- end -}}
{{- with .Values -}}

{{- if and (eq .scope "cluster") .namespaces -}}
{{- $faults = append $faults (printf "namespaces is set (%s), but scope is cluster: the operator would watch every namespace. Set scope=namespaced, or leave namespaces empty." (join ", " .namespaces)) -}}
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

{{- if and (not .metrics.service.create) .metrics.service.annotations -}}
{{- $faults = append $faults "metrics.service.annotations is set, but metrics.service.create is false: there is no Service to carry them. Set metrics.service.create=true, or leave them empty." -}}
{{- end -}}

{{- if and (not .metrics.serviceMonitor.create) .metrics.serviceMonitor.labels -}}
{{- $faults = append $faults "metrics.serviceMonitor.labels is set, but metrics.serviceMonitor.create is false: nothing would carry them. Set metrics.serviceMonitor.create=true, or leave them empty." -}}
{{- end -}}

{{- if and (not .metrics.prometheusRule.create) .metrics.prometheusRule.labels -}}
{{- $faults = append $faults "metrics.prometheusRule.labels is set, but metrics.prometheusRule.create is false: nothing would carry them. Set metrics.prometheusRule.create=true, or leave them empty." -}}
{{- end -}}

{{- if and (not .metrics.dashboard.create) .metrics.dashboard.annotations -}}
{{- $faults = append $faults "metrics.dashboard.annotations is set, but metrics.dashboard.create is false: nothing would carry them. Set metrics.dashboard.create=true, or leave them empty." -}}
{{- end -}}

{{- with .metrics.serviceMonitor -}}
{{- if gt (int .timeoutSeconds) (int .intervalSeconds) -}}
{{- $faults = append $faults (printf "metrics.serviceMonitor.timeoutSeconds is %v, but intervalSeconds is %v: Prometheus refuses a timeout above the interval. Lower the timeout or raise the interval." .timeoutSeconds .intervalSeconds) -}}
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
{{- $faults = append $faults (printf "%s sets %s: the chart sets that label itself, and finds the operator's pod by such labels. Use another label; nameOverride changes app.kubernetes.io/name." $value $label) -}}
{{- end -}}
{{- end -}}
{{- end -}}

{{- if and .userRoles.aggregate (or (not .userRoles.create) (ne .scope "cluster")) -}}
{{- $faults = append $faults "userRoles.aggregate is true, but there is no ClusterRole fiber-user that could extend others: it is made with userRoles.create=true and scope=cluster alone. Set these, or userRoles.aggregate=false and bind the Roles by hand." -}}
{{- end -}}

{{- range $name, $limit := default dict .resources.limits -}}
{{- $request := index (default dict $.Values.resources.requests) $name -}}
{{- if and (not (kindIs "invalid" $request)) (not (kindIs "invalid" $limit)) -}}
{{- if lt (include "fiber-operator.amount" $limit | float64) (include "fiber-operator.amount" $request | float64) -}}
{{- $faults = append $faults (printf "resources.limits.%s is %v, but resources.requests.%s is %v: Kubernetes refuses a container that asks for more than it may have. Raise the limit or lower the request." $name $limit $name $request) -}}
{{- end -}}
{{- end -}}
{{- end -}}

{{- $names := list -}}
{{- range .extraEnv -}}
{{- if has .name $names -}}
{{- $faults = append $faults (printf "extraEnv sets %s twice: only one of the two would apply. Remove one." .name) -}}
{{- end -}}
{{- $names = append $names .name -}}
{{- if regexMatch "(?i)^(https?|all|no)_proxy$" .name -}}
{{- $faults = append $faults (printf "extraEnv sets %s: the operator calls only the API server, and uses no proxy for that. Remove the variable; the nodes set a registry's proxy." .name) -}}
{{- end -}}
{{- if hasPrefix "FIBER_OPERATOR_" .name -}}
{{- $faults = append $faults (printf "extraEnv sets %s: the chart derives the operator's settings from scope, operator and metrics, and rights and probes must agree with them. Set the chart's value instead." .name) -}}
{{- end -}}
{{- end -}}

{{- end -}}

{{- if and .Values.workerNetworkPolicy.create (eq .Values.scope "cluster") (empty .Values.workerNetworkPolicy.namespaces) -}}
{{- $faults = append $faults "workerNetworkPolicy.create is true and scope is cluster, but workerNetworkPolicy.namespaces is empty: a NetworkPolicy belongs to one namespace. Name the namespaces of the pools." -}}
{{- end -}}

{{- with include "fiber-operator.otherOwner" . -}}
{{- $faults = append $faults (printf "crds.install is true, but the resource type FiberPool belongs to release %s, which runs and installs it too: each upgrade of one release would undo the other's. Set crds.install=false here. Or set it there first, and then add --take-ownership here." .) -}}
{{- end -}}

{{- if $faults -}}
{{- fail (printf "these values contradict each other:\n  - %s" (join "\n  - " $faults)) -}}
{{- end -}}
{{- end -}}

{{/* A quantity such as 500m or 1.5Gi, as a plain number. */}}
{{- define "fiber-operator.amount" -}}
{{- $text := toString . -}}
{{- $unit := regexFind "[A-Za-z]+$" $text -}}
{{- $factors := dict "" 1.0 "m" 0.001 "k" 1e3 "M" 1e6 "G" 1e9 "T" 1e12 "P" 1e15 "E" 1e18 "Ki" 1024.0 "Mi" 1048576.0 "Gi" 1073741824.0 "Ti" 1099511627776.0 "Pi" 1125899906842624.0 "Ei" 1152921504606846976.0 -}}
{{- printf "%f" (mulf (trimSuffix $unit $text | float64) (index $factors $unit)) -}}
{{- end -}}

{{/*
The other release, "namespace/name", that installs the resource type and runs; else nothing. Where there is no cluster to
ask (helm template) there is none. One that was uninstalled left its mark on the type, but no Deployment.
*/}}
{{- define "fiber-operator.otherOwner" -}}
{{- if .Values.crds.install -}}
{{- $crd := lookup "apiextensions.k8s.io/v1" "CustomResourceDefinition" "" "fiberpools.fiber.dev" -}}
{{- $marks := dig "metadata" "annotations" dict $crd -}}
{{- $name := index $marks "meta.helm.sh/release-name" -}}
{{- $namespace := index $marks "meta.helm.sh/release-namespace" -}}
{{- if and $name $namespace (ne (printf "%s/%s" $namespace $name) (printf "%s/%s" .Release.Namespace .Release.Name)) -}}
{{- range (lookup "apps/v1" "Deployment" $namespace "").items -}}
{{- $labels := default dict .metadata.labels -}}
{{- $notes := default dict .metadata.annotations -}}
{{- if and (eq "operator" (index $labels "app.kubernetes.io/component" | default "")) (eq $name (index $labels "app.kubernetes.io/instance" | default "")) (eq "true" (index $notes "fiber.dev/installs-crds" | default "")) -}}
{{- printf "%s/%s" $namespace $name -}}
{{- end -}}
{{- end -}}
{{- end -}}
{{- end -}}
{{- end -}}
