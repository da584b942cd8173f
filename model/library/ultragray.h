/* libultragray: frames of UltraG-Ray scenes, in the process of whoever asks for them. A C interface without dependencies.
 *
 *     ultragray_scene *scene = ultragray_load(bytes, size);
 *     ultragray_view *view = ultragray_prepare(scene, "{\"height\": 384, \"width\": 384}");
 *     ultragray_render(view, pose, 1, threads, pixels, NULL);    as often as poses come
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

/* A scene of the bytes of a scene file (.ugr, or .ugz: compressed), which are copied. */
ULTRAGRAY_API ultragray_scene *ultragray_load(const void *bytes, size_t size);
/* A coarser scene of the first bytes of a compressed one (.ugz): of those of its parts that they hold whole. */
ULTRAGRAY_API ultragray_scene *ultragray_load_part(const void *bytes, size_t size);
/* What the scene says of itself: JSON, as long as the scene is there. */
ULTRAGRAY_API const char *ultragray_scene_info(const ultragray_scene *scene);
/* NULL is allowed. Views of the scene stay usable. */
ULTRAGRAY_API void ultragray_free_scene(ultragray_scene *scene);

/* Settings (JSON; NULL: the scene's own) of frames, ready to render by. */
ULTRAGRAY_API ultragray_view *ultragray_prepare(const ultragray_scene *scene, const char *settings);
/* Outputs, encoding, and height, width and place of the picture: JSON, as long as the view is there. */
ULTRAGRAY_API const char *ultragray_view_info(const ultragray_view *view);
/* The bytes of one pose's frame: its outputs one after another, each [height, width] in the encoding; labels uint8. */
ULTRAGRAY_API size_t ultragray_frame_bytes(const ultragray_view *view);
ULTRAGRAY_API void ultragray_free_view(ultragray_view *view);

/* How far a frame extrapolates from what its scene was trained on; NaN is not known. */
typedef struct ultragray_extrapolation {
    double distance_mm;     /* to the nearest training views, a mean over the image */
    double angle_deg;       /* to them */
    double confidence;      /* the MS-SSIM that a real frame at this pose is expected to have with this one, 0 to 1 */
    double supported_share; /* of the pixels: those that Gaussians support */
    double contact_share;   /* of the scan lines: those with contact; NaN where contact is assumed */
    double indentation_mm;  /* of the face, a mean over these; NaN without contact pressure */
    double force_n;         /* of the face on the tissue, along its axis; NaN likewise */
} ultragray_extrapolation;

/* Frames of `count` poses [count, 4, 4] into `pixels`, count * ultragray_frame_bytes(view), on up to so many threads; and how
 * far each extrapolates into `extrapolations` [count], which may be NULL. Returns 0, or another number where it failed. */
ULTRAGRAY_API int ultragray_render(const ultragray_view *view, const double *poses, size_t count, int threads, void *pixels,
                                   ultragray_extrapolation *extrapolations);

/* For renderers that draw planes themselves, such as a GPU's: what ultragray_render draws by, and the rest of a frame. */

/* The scene's Gaussians [count, 12] along a space-filling curve: mean (cm, about the scene's centre), standard deviations
 * (cm), unit quaternion (w, x, y, z), 1 - transmittance, and the distance (cm) beyond which it has no weight. As long as the
 * scene is there. */
ULTRAGRAY_API const float *ultragray_gaussians(const ultragray_scene *scene, size_t *count);
/* Their spherical harmonics [count, (degree + 1)^2], of the degree that the scene's description tells. */
ULTRAGRAY_API const float *ultragray_harmonics(const ultragray_scene *scene);

/* A pose in the terms of docs/physics.md, section 3, about the scene's centre. Booleans are 0 or 1. */
typedef struct ultragray_plan {
    double axes[3][3];               /* rows: lateral, elevation, axial; sheared so that parallel lines are axial */
    double origin[3];                /* cm */
    double near_cm, row_cm, most_cm; /* depth of the first row's upper edge, height of a row, last depth of a mean */
    double start, span;              /* line j of W: start + span (j + 1/2) / W, in cm, or radians from the axial axis */
    double beam[4];                  /* the slice's variance: [0] + [2] (depth - [1])^2, at most [3] */
    double fanned, wrap;             /* lines run from the origin; the first one follows the last */
    double height, width;            /* of the planes */
    double bmode, echo, transmittance, coverage; /* which of them ultragray_finish wants */
    double displaced;                /* whether tissue is, which ultragray_draw alone draws */
} ultragray_plan;

/* What the planes of a pose [4, 4] are drawn by. Returns 0, or another number where it failed. */
ULTRAGRAY_API int ultragray_plan_of(const ultragray_view *view, const double *pose, ultragray_plan *plan);
/* Scan lines of these planes, from `first` to before `end`, each a multiple of 64 or the width: [height, end - first] of each
 * plane that the plan wants, one after another. Several together are the planes, to the bit. */
ULTRAGRAY_API int ultragray_draw(const ultragray_view *view, const double *pose, int first, int end, float *planes);
/* As ultragray_render, of one pose and the planes [height, width] that its plan wants, one after another. */
ULTRAGRAY_API int ultragray_finish(const ultragray_view *view, const double *pose, const float *planes, int threads,
                                   void *pixels, ultragray_extrapolation *extrapolation);

/* What was wrong with the last call of this thread that failed: a sentence, until its next call. */
ULTRAGRAY_API const char *ultragray_problem(void);

#ifdef __cplusplus
}
#endif

#endif
