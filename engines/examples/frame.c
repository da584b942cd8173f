/* frame SCENE OUT: one frame of a scene file as a picture (.pgm), in C. */
#include <stdio.h>
#include <stdlib.h>
#include <ultragray.h>

static void *read_file(const char *path, size_t *size) {
    FILE *file = fopen(path, "rb");
    if (!file || fseek(file, 0, SEEK_END) != 0) return NULL;
    *size = (size_t)ftell(file);
    rewind(file);
    void *bytes = malloc(*size);
    if (bytes && fread(bytes, 1, *size, file) != *size) *size = 0; /* refused as a file that is cut off */
    fclose(file);
    return bytes;
}

int main(int count, char **words) {
    enum { height = 384, width = 384 };
    static unsigned char pixels[height * width];
    const double pose[16] = {1, 0, 0, 0, 0, 1, 0, 19, 0, 0, 1, 0, 0, 0, 0, 1}; /* probe to scene, row by row, mm */
    size_t size = 0;
    void *bytes = count == 3 ? read_file(words[1], &size) : NULL;
    if (!bytes) {
        fprintf(stderr, "usage: frame SCENE OUT, of a scene file that can be read\n");
        return 2;
    }
    ultragray_extrapolation told;
    ultragray_scene *scene = ultragray_load(bytes, size);
    ultragray_view *view = scene ? ultragray_prepare(scene, "{\"height\": 384, \"width\": 384}") : NULL;
    const int failed = !view || ultragray_render(view, pose, 1, 1, pixels, &told) != 0;
    FILE *out = failed ? NULL : fopen(words[2], "wb");
    if (out) {
        fprintf(out, "P5 %d %d 255\n", width, height);
        fwrite(pixels, 1, sizeof pixels, out);
        fclose(out);
        printf("expected similarity %.3f\n", told.confidence);
    } else {
        fprintf(stderr, "%s\n", failed ? ultragray_problem() : "the picture cannot be written");
    }
    ultragray_free_view(view);
    ultragray_free_scene(scene);
    free(bytes);
    return out == NULL;
}
