{{/* A first FiberPool, for people to paste and for the helm test. Called with the context, a name and a size. */}}
{{- define "fiber-operator.pool" -}}
{{- $root := index . 0 -}}
apiVersion: fiber.dev/v1alpha1
kind: FiberPool
metadata:
  name: {{ index . 1 }}
  namespace: {{ include "fiber-operator.someNamespace" $root | quote }}
spec:
  minReplicas: {{ index . 2 }}
  template:
    spec:
      {{- with $root.Values.imagePullSecrets }}
      imagePullSecrets:
        {{- toYaml . | nindent 8 }}
      {{- end }}
      containers:
        - name: worker
          image: {{ include "fiber-operator.workerImage" $root }}
          resources:
            requests:
              cpu: 50m
              memory: 64Mi
{{- end -}}

{{/* The pool of the helm test; its name begins with a letter and has 50 characters at most, as a pool's must. */}}
{{- define "fiber-operator.smokeName" -}}
smoke-{{ include "fiber-operator.fullname" . }}
{{- end -}}
