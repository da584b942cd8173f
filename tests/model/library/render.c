/* render SCENE SETTINGS POSES OUT: frames of poses (doubles, [C, 4, 4]) by libultragray, one after another into OUT. */
#include <stdio.h>
#include <stdlib.h>
#include <ultragray.h>

static unsigned char *read_whole(const char *path, size_t *size) {
    FILE *file = fopen(path, "rb");
    if (!file) return NULL;
    fseek(file, 0, SEEK_END);
    *size = (size_t)ftell(file);
    rewind(file);
    unsigned char *bytes = malloc(*size + 1);
    if (bytes && fread(bytes, 1, *size, file) != *size) *size = 0;
    fclose(file);
    return bytes;
}

int main(int count, char **words) {
    if (count != 5) return 2;
    size_t size = 0, pose_bytes = 0;
    unsigned char *data = read_whole(words[1], &size), *poses = read_whole(words[3], &pose_bytes);
    if (!data || !poses) return 2;
    ultragray_scene *scene = ultragray_load(data, size);
    ultragray_view *view = scene ? ultragray_prepare(scene, words[2]) : NULL;
    ultragray_free_scene(scene);
    free(data);
    const size_t frames = pose_bytes / 128, bytes = view ? frames * ultragray_frame_bytes(view) : 0;
    unsigned char *pixels = malloc(bytes + 1);
    ultragray_extrapolation *figures = calloc(frames + 1, sizeof *figures);
    const int failed = !view || ultragray_render(view, (const double *)poses, frames, 2, pixels, figures) != 0;
    if (failed) fprintf(stderr, "%s\n", ultragray_problem());
    FILE *out = failed ? NULL : fopen(words[4], "wb");
    if (out) fwrite(pixels, 1, bytes, out), fclose(out);
    ultragray_free_view(view);
    free(poses);
    free(pixels);
    free(figures);
    return failed;
}
