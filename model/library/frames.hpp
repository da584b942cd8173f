// From settings and poses to pixels: what ultragray.rendering.frames does, for the CPU and without gradients.
#pragma once

#include <memory>

#include "scene_file.hpp"
#include "tissue.hpp"
#include "tools.hpp"
#include "ultragray.h"

namespace ultragray::library {

// A loaded scene and what was made of it.
struct LoadedScene {
    Scene scene;
    std::unique_ptr<FollowingTissue> tissue;  // null where it is rigid
};

// Settings of frames of one scene, checked and completed, and all of them that does not depend on the pose.
class View {
 public:
    // Of a JSON text, RenderSettings of the contract. Throws Fault.
    View(std::shared_ptr<const LoadedScene> scene, const std::string& settings);

    const Picture& picture() const { return picture_; }
    size_t frame_bytes() const;  // of one pose: its outputs, one after another
    const std::string& json() const { return json_; }
    // Frames of poses [C, 4, 4], mm, row by row. Throws Fault, std::bad_alloc.
    void render(const double* poses, size_t count, int threads, void* pixels) const;
    // The two halves of a frame whose planes are drawn elsewhere: what they are drawn by, and what follows from them, [H, W]
    // each, those that the plan wants one after another. Throws Fault, std::bad_alloc.
    ultragray_plan plan(const double* pose) const;
    void finish(const double* pose, const float* planes, int threads, void* pixels) const;

 private:
    struct KernelView {  // a pose in the terms of the kernels
        double pose[16];
        ProbeGeometry probe;
    };
    struct Sample {  // of a pixel of a scan-converted picture: a place between four pixels of the frame
        int at, below, beside, nearest;
        float down, right;
        bool inside;
    };
    KernelView kernel_view(const Pose& pose) const;
    Planes wanted_planes() const;
    void finish(const Pose& pose, const KernelView& view, Planes& drawn, int threads, unsigned char* pixels) const;
    std::vector<float> labels(const KernelView& view, int threads) const;
    bool asks_for(const char* output) const;
    void put(const std::string& output, std::vector<float>& plane, unsigned char* pixels) const;
    void set_tone(std::vector<float>& bmode) const;
    void sharpen(std::vector<float>& bmode) const;
    std::vector<Sample> samples() const;

    std::shared_ptr<const LoadedScene> scene_;
    RenderSettings settings_;
    Display display_;
    Probing probe_;                      // as asked for
    std::optional<ElevationBeam> beam_;  // likewise
    int height_, width_, rows_;          // as rendered, and the rows of it that are shown
    Picture picture_;
    std::vector<float> lift_;  // [rows]: what tone adds
    std::vector<Sample> samples_;
    std::string json_;
};

}  // namespace ultragray::library
