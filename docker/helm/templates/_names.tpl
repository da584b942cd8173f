{{- define "ultragray.name" -}}
{{- .Release.Name | trunc 40 | trimSuffix "-" -}}
{{- end -}}

{{/* The labels of one part: a list of the root and the part's name. */}}
{{- define "ultragray.selector" -}}
app.kubernetes.io/name: ultragray
app.kubernetes.io/instance: {{ (first .).Release.Name }}
app.kubernetes.io/component: {{ last . }}
{{- end -}}

{{- define "ultragray.labels" -}}
{{ include "ultragray.selector" . }}
app.kubernetes.io/version: {{ (first .).Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ (first .).Release.Service }}
{{- end -}}

{{/* The image of a service or group of workers: a list of the root and its values. */}}
{{- define "ultragray.image" -}}
{{- $image := mergeOverwrite (deepCopy (first .).Values.image) (last .).image -}}
{{ $image.repository }}:{{ $image.tag }}
{{- end -}}
