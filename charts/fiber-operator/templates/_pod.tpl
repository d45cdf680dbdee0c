{{/* The operator's settings: what the scope and the values say, and what only the pod knows. */}}
{{- define "fiber-operator.environment" -}}
- name: FIBER_OPERATOR_NAMESPACES
  value: {{ include "fiber-operator.namespaces" . | fromJsonArray | join "," | quote }}
- name: FIBER_OPERATOR_NAMESPACE
  valueFrom:
    fieldRef:
      fieldPath: metadata.namespace
# The holder of the Lease: a container that was restarted in its pod goes on at once.
- name: FIBER_OPERATOR_IDENTITY
  valueFrom:
    fieldRef:
      fieldPath: metadata.name
- name: FIBER_OPERATOR_LEASE
  value: {{ include "fiber-operator.fullname" . }}
- name: FIBER_OPERATOR_LEASE_SECONDS
  value: {{ .Values.operator.leaseSeconds | quote }}
- name: FIBER_OPERATOR_LISTEN
  value: {{ printf ":%v" .Values.metrics.port | quote }}
- name: FIBER_OPERATOR_RESYNC_SECONDS
  value: {{ .Values.operator.resyncSeconds | quote }}
- name: FIBER_OPERATOR_CONCURRENCY
  value: {{ .Values.operator.concurrency | quote }}
- name: FIBER_OPERATOR_CONNECTIONS
  value: {{ .Values.operator.connections | quote }}
- name: FIBER_OPERATOR_CPU_REQUEST
  value: {{ .Values.workers.defaultRequests.cpu | toString | quote }}
- name: FIBER_OPERATOR_MEMORY_REQUEST
  value: {{ .Values.workers.defaultRequests.memory | toString | quote }}
- name: FIBER_OPERATOR_LOG_LEVEL
  value: {{ .Values.operator.logLevel }}
- name: FIBER_OPERATOR_LOG_FORMAT
  value: {{ .Values.operator.logFormat }}
{{- with .Values.extraEnv }}
{{ toYaml . }}
{{- end }}
{{- end -}}

{{/*
What the Pod Security Standard "restricted" asks for. No user id: the image brings a numeric one, and OpenShift
chooses its own.
*/}}
{{- define "fiber-operator.podSecurity" -}}
securityContext:
  runAsNonRoot: true
  seccompProfile:
    type: RuntimeDefault
{{- end -}}

{{- define "fiber-operator.containerSecurity" -}}
securityContext:
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities:
    drop: [ALL]
{{- end -}}

{{/* Where the operator's image comes from and where its pods may run: the same for the operator and the helm test. */}}
{{- define "fiber-operator.placement" -}}
{{- with .Values.imagePullSecrets }}
imagePullSecrets:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .Values.nodeSelector }}
nodeSelector:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .Values.affinity }}
affinity:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- end -}}

{{/*
Taints that the operator's pod tolerates. Kubernetes would leave it on a lost node for five minutes; another pod may come
much sooner, since the operator's Lease keeps the two apart. Values that speak of these taints themselves win.
*/}}
{{- define "fiber-operator.tolerations" -}}
{{- $tolerations := .Values.tolerations -}}
{{- range $taint := list "node.kubernetes.io/not-ready" "node.kubernetes.io/unreachable" -}}
{{- $told := false -}}
{{- range $.Values.tolerations -}}
{{- if and (eq $taint (default $taint .key)) (eq "NoExecute" (default "NoExecute" .effect)) -}}
{{- $told = true -}}
{{- end -}}
{{- end -}}
{{- if not $told -}}
{{- $tolerations = append $tolerations (dict "key" $taint "operator" "Exists" "effect" "NoExecute" "tolerationSeconds" 30) -}}
{{- end -}}
{{- end -}}
{{- with $tolerations -}}
{{- toYaml . -}}
{{- end -}}
{{- end -}}

{{/*
What makes an object part of `helm test` alone; called with its place in the order, and with what deletes it beside the
next test.
*/}}
{{- define "fiber-operator.testHook" -}}
helm.sh/hook: test
helm.sh/hook-weight: {{ index . 0 | quote }}
helm.sh/hook-delete-policy: {{ join "," (concat (list "before-hook-creation") (rest .)) }}
{{- end -}}
