{{/* What every pod here has in common. A list of the root, the part's name and its values. */}}
{{- define "ultragray.pod" -}}
{{- $root := index . 0 -}}{{- $part := index . 1 -}}{{- $values := index . 2 -}}
serviceAccountName: {{ include "ultragray.name" $root }}
automountServiceAccountToken: false
{{- with $root.Values.image.pullSecrets }}
imagePullSecrets:
  {{- range . }}
  - name: {{ . }}
  {{- end }}
{{- end }}
securityContext:
  runAsNonRoot: true
  runAsUser: 10001
  runAsGroup: 10001
  fsGroup: 10001
  fsGroupChangePolicy: OnRootMismatch
  seccompProfile: {type: RuntimeDefault}
topologySpreadConstraints:
  {{- range list "kubernetes.io/hostname" "topology.kubernetes.io/zone" }}
  - maxSkew: 1
    topologyKey: {{ . }}
    whenUnsatisfiable: ScheduleAnyway
    labelSelector:
      matchLabels: {{- include "ultragray.selector" (list $root $part) | nindent 8 }}
  {{- end }}
{{- with $values.nodeSelector }}
nodeSelector: {{- toYaml . | nindent 2 }}
{{- end }}
{{- with $values.tolerations }}
tolerations: {{- toYaml . | nindent 2 }}
{{- end }}
{{- with $values.affinity }}
affinity: {{- toYaml . | nindent 2 }}
{{- end }}
{{- end -}}

{{- define "ultragray.container-security" -}}
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities: {drop: [ALL]}
{{- end -}}

{{/* The settings and secrets of services and workers. A list of the root and a dictionary of the part's own settings. */}}
{{- define "ultragray.environment" -}}
{{- $root := first . -}}
{{- $storage := $root.Values.storage -}}
{{- $settings := dict
  "data_folder" (required "storage.dataFolder is missing: s3://BUCKET/PREFIX, gs://…, az://…, or a folder below /data" $storage.dataFolder)
  "artifact_folder" (required "storage.artifactFolder is missing: s3://BUCKET/PREFIX, gs://…, az://…, or a folder below /data" $storage.artifactFolder)
  "max_cache_bytes" (mul $root.Values.cache.sizeGb 1000000000 | toString)
-}}
{{- $settings = merge (deepCopy $root.Values.settings) (last .) $settings -}}
envFrom:
  {{- range $root.Values.secretNames }}
  - secretRef: {name: {{ . }}}
  {{- end }}
env:
  - name: ULTRAGRAY_DATABASE_URL
    valueFrom:
      secretKeyRef:
        name: {{ required "database.secretName is missing: the name of a Secret with the URL of PostgreSQL" $root.Values.database.secretName }}
        key: {{ $root.Values.database.secretKey }}
  {{- range $name, $value := $settings }}
  - name: ULTRAGRAY_{{ upper $name }}
    value: {{ $value | toString | quote }}
  {{- end }}
  {{- range $name, $value := $root.Values.environment }}
  - name: {{ $name }}
    value: {{ $value | toString | quote }}
  {{- end }}
{{- end -}}

{{/* What services and workers write: a list of the root and the part's values. The GPUs stand with the resources. */}}
{{- define "ultragray.mounts" -}}
volumeMounts:
  - {name: temporary, mountPath: /tmp}
  - {name: cache, mountPath: /var/cache/ultragray}
  {{- if (first .).Values.storage.existingClaim }}
  - {name: data, mountPath: /data}
  {{- end }}
resources:
  {{- with (last .).resources.requests }}
  requests: {{- toYaml . | nindent 4 }}
  {{- end }}
  limits:
    {{- with (last .).resources.limits }}
    {{- toYaml . | nindent 4 }}
    {{- end }}
    {{- with (last .).gpus }}
    nvidia.com/gpu: {{ . }}
    {{- end }}
{{- end -}}

{{- define "ultragray.volumes" -}}
volumes:
  - name: temporary
    emptyDir: {sizeLimit: {{ .Values.cache.workGb }}G}
  - name: cache
    emptyDir: {sizeLimit: {{ add .Values.cache.sizeGb .Values.cache.workGb }}G}
  {{- with .Values.storage.existingClaim }}
  - name: data
    persistentVolumeClaim: {claimName: {{ . }}}
  {{- end }}
{{- end -}}
