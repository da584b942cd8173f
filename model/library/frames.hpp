// From settings and poses to pixels: what ultragray.rendering.frames does, for the CPU and without gradients.
#pragma once

#include <memory>
#include <mutex>

#include "../kernels/pressing.hpp"
#include "contact.hpp"
#include "scene_file.hpp"
#include "speckle.hpp"
#include "tissue.hpp"
#include "tools.hpp"

namespace ultragray::library {

// A loaded scene and what was made of it.
class LoadedScene {
 public:
    explicit LoadedScene(Scene read);
    const Skin& skin() const;  // made once it is asked for. Throws Fault where none is known
    Pose at_rest(const Pose& pose) const { return tissue_ ? tissue_->at_rest(pose) : pose; }
    // The training poses, in the tissue at rest.
    const std::vector<Pose>& poses_at_rest() const { return tissue_ ? scene.rest_poses : scene.training_poses; }
    const ConfidenceModel* confidence() const { return scene.info.confidence ? &*scene.info.confidence : nullptr; }

    std::shared_ptr<const Compliance> compliance() const;  // of the tissue, made once it is asked for

    const Scene scene;
    // Of training views as tracked, and of those in the tissue at rest; null where they are not known.
    std::unique_ptr<TrainingViews> views, views_at_rest;
    std::unique_ptr<SpeckleOfScene> speckle;  // null where training fitted none

 private:
    std::unique_ptr<FollowingTissue> tissue_;  // null where it is rigid
    mutable std::mutex lock_;                  // of what is made later
    mutable std::unique_ptr<Skin> skin_;
    mutable std::shared_ptr<const Compliance> compliance_;
};

// What the pose of a frame leads to, before anything is drawn: where the probe sees the tissue at rest, as the kernels take
// it, and where it touches the skin.
struct Sight {
    std::string name;  // of the pose, in messages
    Pose pose;         // as tracked
    Pose at_rest;
    ProbeGeometry geometry;
    double matrix[16];
    std::optional<Touch> touch;      // none: contact is assumed
    std::optional<Pressed> pressed;  // none: no tissue is displaced
    double indentation_mm = std::nan("");
    double force_n = std::nan("");
    Displacements displacements(const Vector& centre_mm) const;
};

// Settings of frames of one scene, checked and completed, and all of them that does not depend on the pose.
class View {
 public:
    // Of a JSON text, RenderSettings of the contract. Throws Fault.
    View(std::shared_ptr<const LoadedScene> scene, const std::string& settings);

    const Picture& picture() const { return picture_; }
    size_t frame_bytes() const;  // of one pose: its outputs, one after another
    const std::string& json() const { return json_; }
    // Frames of poses [C, 4, 4], mm, row by row, and how far each extrapolates [C], where that is not null. Throws Fault,
    // std::bad_alloc.
    void render(const double* poses, size_t count, int threads, void* pixels, Extrapolation* extrapolations) const;
    // The parts of a frame whose planes are drawn elsewhere, or in shares: what they are drawn by, some scan lines of them,
    // and what follows from them, [H, W] each, those that the plan wants one after another. Throws Fault, std::bad_alloc.
    ultragray_plan plan(const double* pose) const;
    void draw(const double* pose, int first_line, int end_line, float* planes) const;
    Extrapolation finish(const double* pose, const float* planes, int threads, void* pixels) const;

 private:
    struct Sample {  // of a pixel of a scan-converted picture: a place between four pixels of the frame
        int at, below, beside, nearest;
        float down, right;
        bool inside;
    };
    Sight sight_of(const double* matrix, const std::string& name) const;
    void press(Sight& sight) const;
    Planes wanted_planes(bool judged) const;
    void draw(const Sight& sight, const Lines& lines, int threads, Planes& planes) const;
    // From planes to pixels. What the pose alone tells of its extrapolation is completed; null: nobody wants to know.
    void finish(const Sight& sight, Planes& drawn, int threads, Extrapolation* judged, unsigned char* pixels) const;
    Extrapolation judged_by_pose(const Sight& sight) const;
    void require_confidence(const Sight& sight, const Extrapolation& found) const;
    std::vector<float> labels(const Sight& sight, int threads) const;
    std::vector<float> attenuation(const std::vector<float>& transmittance) const;
    std::vector<float> uncertainty(const Sight& sight, const Planes& drawn) const;
    bool asks_for(const char* output) const;
    size_t bytes_per_pixel(const std::string& output) const;
    void put(const std::string& output, const std::vector<float>& plane, unsigned char* pixels) const;
    void set_tone(std::vector<float>& bmode, const Pose& pose) const;
    void sharpen(std::vector<float>& bmode) const;
    std::vector<Sample> samples() const;

    std::shared_ptr<const LoadedScene> scene_;
    RenderSettings settings_;
    Display display_;
    Probing probe_;
    std::optional<ElevationBeam> beam_;  // likewise
    int height_, width_, rows_;          // as rendered, and the rows of it that are shown
    Picture picture_;
    std::vector<Sample> samples_;
    std::unique_ptr<Press> press_;             // null without contact pressure
    std::unique_ptr<SpeckleSamples> speckle_;  // null where none is drawn
    std::string json_;
};

}  // namespace ultragray::library
