{{/*
Every right that the chart gives, as data: no condition and no loop, so that a test can compare the lists with the
calls that the operator makes, both ways.

  pools    the operator, in each namespace that it watches
  own      the operator, in its own namespace: the Lease that keeps two of its processes from acting at once
  user     who runs pools: people, and the programs that are masters
  viewer   who looks on
  smoke    the helm test
*/}}
{{- define "fiber-operator.rules" -}}
pools:
  # Delete: a pool that says so goes when its master is lost. Its spec is never written.
  - apiGroups: [fiber.dev]
    resources: [fiberpools]
    verbs: [delete, get, list, watch]
  - apiGroups: [fiber.dev]
    resources: [fiberpools/status]
    verbs: [patch]
  - apiGroups: [""]
    resources: [pods]
    verbs: [create, delete, list, watch]
  - apiGroups: [""]
    resources: [services]
    verbs: [create, get, patch]
  # Never list: the operator knows the name of each Secret that it made, and reads no other.
  - apiGroups: [""]
    resources: [secrets]
    verbs: [create, get]
  - apiGroups: [discovery.k8s.io]
    resources: [endpointslices]
    verbs: [create, delete, get, patch]
  # Get: the Lease that a master renews; the operator only looks at it. The name of what is created cannot be restricted.
  - apiGroups: [coordination.k8s.io]
    resources: [leases]
    verbs: [create, get]
  # The Lease that keeps the operators of two releases from acting in one namespace.
  - apiGroups: [coordination.k8s.io]
    resources: [leases]
    resourceNames: [fiberpools.fiber.dev]
    verbs: [update]
  # List: what the scheduler and the kubelet say of a pod that does not start.
  - apiGroups: [""]
    resources: [events]
    verbs: [create, list, patch]
own:
  # The name of what is created cannot be restricted.
  - apiGroups: [coordination.k8s.io]
    resources: [leases]
    verbs: [create]
  - apiGroups: [coordination.k8s.io]
    resources: [leases]
    resourceNames: [{{ include "fiber-operator.fullname" . }}]
    verbs: [get, update]
user:
  - apiGroups: [fiber.dev]
    resources: [fiberpools]
    verbs: [create, delete, deletecollection, get, list, patch, update, watch]
  - apiGroups: [fiber.dev]
    resources: [fiberpools/scale]
    verbs: [get, patch, update]
  - apiGroups: [fiber.dev]
    resources: [fiberpools/status]
    verbs: [get]
  # A master reads the credentials of its pool by name.
  - apiGroups: [""]
    resources: [secrets]
    verbs: [get]
  # A master renews a Lease, so that its pool is not kept for a program that is gone.
  - apiGroups: [coordination.k8s.io]
    resources: [leases]
    verbs: [create, delete, get, patch, update]
  - apiGroups: [""]
    resources: [events, pods]
    verbs: [get, list, watch]
  - apiGroups: [""]
    resources: [pods/log]
    verbs: [get]
viewer:
  - apiGroups: [fiber.dev]
    resources: [fiberpools]
    verbs: [get, list, watch]
  - apiGroups: [fiber.dev]
    resources: [fiberpools/scale, fiberpools/status]
    verbs: [get]
  - apiGroups: [""]
    resources: [events, pods]
    verbs: [get, list, watch]
  - apiGroups: [""]
    resources: [pods/log]
    verbs: [get]
smoke:
  - apiGroups: [fiber.dev]
    resources: [fiberpools]
    verbs: [create]
  - apiGroups: [fiber.dev]
    resources: [fiberpools]
    resourceNames: [{{ include "fiber-operator.smokeName" . }}]
    verbs: [delete, get]
{{- end -}}
