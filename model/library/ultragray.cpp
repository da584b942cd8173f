// The C interface: no exception leaves it.
#include "ultragray.h"

#include <cstdio>
#include <new>

#include "frames.hpp"

using namespace ultragray::library;

struct ultragray_scene {
    std::shared_ptr<const LoadedScene> scene;
};
struct ultragray_view {
    View view;
};

namespace {

thread_local char problem[1024];  // nothing that wants to be destroyed as a thread ends: WebAssembly has no such end

void tell(const char* sentence) { std::snprintf(problem, sizeof problem, "%s", sentence); }

// What `act` returns, or `failed`, with the problem told.
template <class Result, class Act>
Result guarded(Result failed, const Act& act) {
    try {
        return act();
    } catch (const std::bad_alloc&) {
        tell("the memory does not suffice");
    } catch (const std::exception& error) {
        tell(error.what());
    }
    return failed;
}

ultragray_scene* read(const void* bytes, size_t size, Extent extent) {
    return guarded<ultragray_scene*>(nullptr, [&] {
        if (bytes == nullptr) throw Fault("there are no bytes of a scene file");
        return new ultragray_scene{std::make_shared<LoadedScene>(Scene::read(bytes, size, extent))};
    });
}

}  // namespace

ultragray_scene* ultragray_load(const void* bytes, size_t size) { return read(bytes, size, Extent::Whole); }

ultragray_scene* ultragray_load_part(const void* bytes, size_t size) { return read(bytes, size, Extent::Beginning); }

const char* ultragray_scene_info(const ultragray_scene* scene) { return scene->scene->scene.info.json.c_str(); }

void ultragray_free_scene(ultragray_scene* scene) { delete scene; }

ultragray_view* ultragray_prepare(const ultragray_scene* scene, const char* settings) {
    return guarded<ultragray_view*>(nullptr, [&] {
        if (scene == nullptr) throw Fault("there is no scene");
        return new ultragray_view{View(scene->scene, settings ? settings : "")};
    });
}

const char* ultragray_view_info(const ultragray_view* view) { return view->view.json().c_str(); }

size_t ultragray_frame_bytes(const ultragray_view* view) { return view->view.frame_bytes(); }

void ultragray_free_view(ultragray_view* view) { delete view; }

int ultragray_render(const ultragray_view* view, const double* poses, size_t count, int threads, void* pixels,
                     ultragray_extrapolation* extrapolations) {
    return guarded(1, [&] {
        if (view == nullptr || poses == nullptr || pixels == nullptr) throw Fault("view, poses and pixels must be given");
        view->view.render(poses, count, threads < 1 ? 1 : threads, pixels, extrapolations);
        return 0;
    });
}

const float* ultragray_gaussians(const ultragray_scene* scene, size_t* count) {
    static_assert(sizeof(ultragray::Gaussian) == 12 * sizeof(float), "the header says so");
    const ultragray::SceneView view = scene->scene->scene.gaussians->view();
    *count = size_t(view.count);
    return reinterpret_cast<const float*>(view.gaussians);
}

const float* ultragray_harmonics(const ultragray_scene* scene) { return scene->scene->scene.gaussians->view().sh; }

int ultragray_plan_of(const ultragray_view* view, const double* pose, ultragray_plan* plan) {
    return guarded(1, [&] {
        if (view == nullptr || pose == nullptr || plan == nullptr) throw Fault("view, pose and plan must be given");
        *plan = view->view.plan(pose);
        return 0;
    });
}

int ultragray_draw(const ultragray_view* view, const double* pose, int first, int end, float* planes) {
    return guarded(1, [&] {
        if (view == nullptr || pose == nullptr || planes == nullptr) throw Fault("view, pose and planes must be given");
        view->view.draw(pose, first, end, planes);
        return 0;
    });
}

int ultragray_finish(const ultragray_view* view, const double* pose, const float* planes, int threads, void* pixels,
                     ultragray_extrapolation* extrapolation) {
    return guarded(1, [&] {
        if (view == nullptr || pose == nullptr || planes == nullptr || pixels == nullptr)
            throw Fault("view, pose, planes and pixels must be given");
        const Extrapolation found = view->view.finish(pose, planes, threads < 1 ? 1 : threads, pixels);
        if (extrapolation) *extrapolation = found;
        return 0;
    });
}

const char* ultragray_problem(void) { return problem; }
