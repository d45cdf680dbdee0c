{{/*
Every right that the chart gives, as data: no condition and no loop, so that a test can compare the lists with the
calls that the operator makes, both ways.

  pools    the operator, in each namespace that it watches
  own      the operator, in its own namespace: the Lease that keeps two of its processes from acting at once
  serving  the operator, where it shows that it serves: in each namespace that it watches, or in kube-public for all
  anyone   all accounts, in kube-public: to see whether an operator serves all namespaces
  user     programs that are masters: exactly the calls of the SDK
  runner   people who start programs in pods by `fiber run`, in addition to user
  viewer   people who only look
  smoke    the helm test
*/}}
{{- define "fiber-operator.rules" -}}
pools:
  # Delete: a pool with onLost Delete is deleted when its master is lost. The spec is never written.
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
  # Never list: the operator knows the name of each Secret that it made or that a pool names, and reads no other.
  - apiGroups: [""]
    resources: [secrets]
    verbs: [create, get]
  - apiGroups: [discovery.k8s.io]
    resources: [endpointslices]
    verbs: [create, delete, get, patch]
  # For pools whose master pods cannot reach (spec.relay).
  - apiGroups: [apps]
    resources: [deployments]
    verbs: [create, delete, get]
  # For pools with spec.minAvailable.
  - apiGroups: [policy]
    resources: [poddisruptionbudgets]
    verbs: [create, delete, get, patch]
  # The Leases that masters renew. The operator only reads them.
  - apiGroups: [coordination.k8s.io]
    resources: [leases]
    verbs: [get, list, watch]
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
    resourceNames: [{{ include "fiber-operator.leaseName" . }}]
    verbs: [get, update]
serving:
  - apiGroups: [coordination.k8s.io]
    resources: [leases]
    verbs: [create]
  - apiGroups: [coordination.k8s.io]
    resources: [leases]
    resourceNames: [operator.fiber.dev]
    verbs: [patch]
anyone:
  - apiGroups: [coordination.k8s.io]
    resources: [leases]
    resourceNames: [operator.fiber.dev]
    verbs: [get]
user:
  - apiGroups: [fiber.dev]
    resources: [fiberpools]
    verbs: [create, delete, get, list, patch, watch]
  # A master makes the credentials of its own pool itself. It reads no Secret: for a pool of another owner, the operator
  # signs its certificate in the status.
  - apiGroups: [""]
    resources: [secrets]
    verbs: [create]
  # A master renews a Lease, so that its pool is not kept for a program that is gone. What it made goes with the pool.
  # Get: also the Lease by which an operator of this namespace alone shows that it serves.
  - apiGroups: [coordination.k8s.io]
    resources: [leases]
    verbs: [create, get, patch, update]
  # Why a worker ended; and its own pod, whose image and settings its workers take.
  - apiGroups: [""]
    resources: [pods]
    verbs: [get, list, watch]
  # The way to the relay of a pool, for a program that pods cannot reach. A WebSocket begins with a GET, and newer API
  # servers also ask for the right to create. Kubernetes cannot restrict the right to the pods of relays.
  - apiGroups: [""]
    resources: [pods/portforward]
    verbs: [create, get]
  # Whether workers on other nodes can mount the claims of that pod.
  - apiGroups: [""]
    resources: [persistentvolumeclaims]
    verbs: [get]
runner:
  # Whether the account of programs exists.
  - apiGroups: [""]
    resources: [serviceaccounts]
    verbs: [get]
  # Not for programs: who may make Jobs runs pods as any account of the namespace.
  - apiGroups: [batch]
    resources: [jobs]
    verbs: [create, delete, get, list]
  - apiGroups: [""]
    resources: [pods/log]
    verbs: [get]
  # Why a Job has no pod: a quota, for example.
  - apiGroups: [""]
    resources: [events]
    verbs: [list]
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
