/* libultragray: frames of UltraG-Ray scenes, in the process of whoever asks for them. A C interface without dependencies.
 *
 *     ultragray_scene *scene = ultragray_load(bytes, size);
 *     ultragray_view *view = ultragray_prepare(scene, "{\"height\": 384, \"width\": 384}");
 *     ultragray_render(view, pose, 1, threads, pixels);      as often as poses come
 *
 * A pose is a matrix [4, 4] of doubles, row by row: the rigid transform from the probe to the scene, in mm, of right-handed
 * axes. Settings are those of RenderSettings of the HTTP interface, as JSON; what a service alone can do is refused.
 * Whatever fails returns NULL, or a number that is not 0; ultragray_problem() then says in a sentence what was wrong.
 * Several threads may use a scene and a view at the same time.
 */
#ifndef ULTRAGRAY_H
#define ULTRAGRAY_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

#if defined(_WIN32)
#define ULTRAGRAY_API __declspec(dllexport)
#else
#define ULTRAGRAY_API __attribute__((visibility("default")))
#endif

typedef struct ultragray_scene ultragray_scene; /* the Gaussians of a scene file, and what it says of itself */
typedef struct ultragray_view ultragray_view;   /* settings of frames of one scene */

/* A scene of the bytes of a scene file (.ugr), which are copied. */
ULTRAGRAY_API ultragray_scene *ultragray_load(const void *bytes, size_t size);
/* What the scene says of itself: JSON, as long as the scene is there. */
ULTRAGRAY_API const char *ultragray_scene_info(const ultragray_scene *scene);
/* NULL is allowed. Views of the scene stay usable. */
ULTRAGRAY_API void ultragray_free_scene(ultragray_scene *scene);

/* Settings (JSON; NULL: the scene's own) of frames, ready to render by. */
ULTRAGRAY_API ultragray_view *ultragray_prepare(const ultragray_scene *scene, const char *settings);
/* Outputs, encoding, and height, width and place of the picture: JSON, as long as the view is there. */
ULTRAGRAY_API const char *ultragray_view_info(const ultragray_view *view);
/* The bytes of one pose's frame: its outputs one after another, each [height, width] of uint8 or float32; labels uint8. */
ULTRAGRAY_API size_t ultragray_frame_bytes(const ultragray_view *view);
ULTRAGRAY_API void ultragray_free_view(ultragray_view *view);

/* Frames of `count` poses [count, 4, 4] into `pixels`, count * ultragray_frame_bytes(view), on up to so many threads.
 * Returns 0, or another number where it failed. */
ULTRAGRAY_API int ultragray_render(const ultragray_view *view, const double *poses, size_t count, int threads, void *pixels);

/* What was wrong with the last call of this thread that failed: a sentence, until its next call. */
ULTRAGRAY_API const char *ultragray_problem(void);

#ifdef __cplusplus
}
#endif

#endif
