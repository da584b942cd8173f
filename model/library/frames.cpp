#include "frames.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "../kernels/render.hpp"

namespace ultragray::library {
namespace {

constexpr double kFrameRangeDb = 60.0;
constexpr float kLeastWeightSum = 1.0f / 255.0f;  // a label with less is not seen
constexpr float kSpentBeam = 1e-4f;               // nothing can be said of what is taken from less
const std::vector<std::string> kOutputs = {"bmode", "echo", "transmittance", "coverage", "attenuation", "labels"};

bool is_numbers(const std::string& output) { return output == "labels"; }

// What this library leaves to a service.
void check_local(const RenderSettings& settings, const SceneInfo& info) {
    const auto refuse = [](const std::string& field, const std::string& reason) { throw Fault(field + " " + reason); };
    if (settings.min_confidence)
        refuse("min_confidence", "can be judged by a service alone: local frames tell no confidence");
    if (settings.registration) refuse("registration", "is kept by a service: local poses are probe to scene");
    if (settings.encoding != Encoding::Uint8 && settings.encoding != Encoding::Float32)
        refuse("encoding", "must be uint8 or float32 for local frames");
    if (settings.contact) refuse("contact", "can be shown by a service alone");
    if (settings.speckle != Speckle::Off) refuse("speckle", "can be drawn by a service alone");
    if (settings.display &&
        (!settings.display->gain_db_between.empty() || !settings.display->dynamic_range_db_between.empty()))
        refuse("display", "can be drawn at random by a service alone");
    for (const std::string& output : settings.outputs) {
        if (std::find(kOutputs.begin(), kOutputs.end(), output) == kOutputs.end())
            refuse("outputs", "must be some of " + joined(kOutputs) + ", got '" + output + "'");
        if (is_numbers(output) && info.label_names.empty() && (!settings.tools || settings.tools->empty()))
            refuse("outputs", "may name labels only for a scene whose Gaussians carry labels, or for frames with tools");
    }
}

RenderSettings settings_of(const std::string& text, const SceneInfo& info) {
    const Json document = Json::parse(text.empty() ? "{}" : text, nullptr, false);
    if (document.is_discarded()) throw Fault("the settings are no JSON");
    RenderSettings settings = RenderSettings::read(Value(document, ""));
    std::vector<std::string> once;
    for (const std::string& output : settings.outputs)
        if (std::find(once.begin(), once.end(), output) == once.end()) once.push_back(output);
    settings.outputs = once;
    check_local(settings, info);
    return settings;
}

Probing probe_of(const RenderSettings& settings, const SceneInfo& info) {
    if (!settings.probe && !info.probe)
        throw Fault("probe must be given: the scene does not know the one it was trained with");
    return Probing::of(settings.probe ? *settings.probe : *info.probe);
}

std::optional<ElevationBeam> beam_of(const RenderSettings& settings, const SceneInfo& info) {
    std::optional<ElevationBeam> beam = info.beam;
    if (settings.slice_thickness_mm) {
        if (!beam) beam.emplace();
        beam->thickness_mm = *settings.slice_thickness_mm;
    }
    return beam;
}

int rows_shown(const Display& display, const Probing& probe, int height) {
    if (!display.depth_mm) return height;
    const double share = (probe.face_mm + *display.depth_mm - probe.near_mm) / probe.length_mm();
    return std::max(1, int(std::nearbyint(height * std::min(share, 1.0))));
}

unsigned char rounded(float value) {
    return static_cast<unsigned char>(std::nearbyint(std::clamp(value, 0.0f, 1.0f) * 255.0f));
}

}  // namespace

View::View(std::shared_ptr<const LoadedScene> scene, const std::string& settings)
    : scene_(std::move(scene)),
      settings_(settings_of(settings, scene_->scene.info)),
      display_(settings_.display.value_or(Display{})),
      probe_(probe_of(settings_, scene_->scene.info)),
      beam_(beam_of(settings_, scene_->scene.info)),
      height_(int(settings_.height.value_or(scene_->scene.info.height))),
      width_(int(settings_.width.value_or(scene_->scene.info.width))),
      rows_(rows_shown(display_, probe_, height_)) {
    const Probing shown = probe_.ending_at(probe_.near_mm + double(rows_) / height_ * probe_.length_mm());
    picture_ = display_.pixel_mm ? Picture::of_plane(shown, *display_.pixel_mm) : Picture::of_frame(shown, rows_, width_);
    if (display_.pixel_mm) samples_ = samples();
    const bool toned = display_.gain_db != 0.0 || display_.dynamic_range_db != kFrameRangeDb ||
                       std::any_of(display_.tgc_db.begin(), display_.tgc_db.end(), [](double gain) { return gain != 0.0; });
    for (int row = 0; toned && row < rows_; ++row) {
        double gain = display_.gain_db;
        const std::vector<double>& points = display_.tgc_db;
        if (!points.empty()) {
            const double place = (row + 0.5) / rows_ * double(points.size() - 1);
            const size_t low = std::min(size_t(place), points.size() - 1), high = std::min(low + 1, points.size() - 1);
            gain += points[low] + (place - double(low)) * (points[high] - points[low]);
        }
        const double scale = kFrameRangeDb / display_.dynamic_range_db;
        lift_.push_back(float(1.0 - scale) + float(gain) / float(display_.dynamic_range_db));
    }
    if (display_.flip) {
        picture_.first[0] += (picture_.width - 1) * picture_.step[0];
        picture_.step[0] = -picture_.step[0];
    }
    json_ = Json{{"outputs", settings_.outputs},
                 {"encoding", settings_.encoding == Encoding::Uint8 ? "uint8" : "float32"},
                 {"rendered_height", height_},
                 {"rendered_width", width_},
                 {"height", picture_.height},
                 {"width", picture_.width},
                 {"picture",
                  {{"height", picture_.height},
                   {"width", picture_.width},
                   {"column_unit", picture_.column_unit},
                   {"first", {picture_.first[0], picture_.first[1]}},
                   {"step", {picture_.step[0], picture_.step[1]}}}}}
                .dump();
}

size_t View::frame_bytes() const {
    size_t bytes = 0;
    for (const std::string& output : settings_.outputs)
        bytes += is_numbers(output) || settings_.encoding == Encoding::Uint8 ? 1 : sizeof(float);
    return bytes * size_t(picture_.height) * size_t(picture_.width);
}

void View::render(const double* poses, size_t count, int threads, void* pixels) const {
    auto* out = static_cast<unsigned char*>(pixels);
    for (size_t c = 0; c < count; ++c) {
        const Pose pose = Pose::read(poses + 16 * c, "poses[" + std::to_string(c) + "]");
        const KernelView view = kernel_view(pose);
        Planes planes = wanted_planes();
        const auto at = [](std::vector<float>& plane) { return plane.empty() ? nullptr : plane.data(); };
        if (at(planes.bmode) || at(planes.echo) || at(planes.transmittance) || at(planes.coverage))
            ultragray::render(*scene_->scene.gaussians, view.probe, view.pose, 1, height_, width_, threads, "auto",
                              {at(planes.bmode), at(planes.echo), at(planes.transmittance), at(planes.coverage), nullptr,
                               nullptr, nullptr, nullptr, 0.0f},
                              {});
        finish(pose, view, planes, threads, out + c * frame_bytes());
    }
}

ultragray_plan View::plan(const double* pose) const {
    const KernelView view = kernel_view(Pose::read(pose, "pose"));
    const ProbeGeometry& probe = view.probe;
    const Planes planes = wanted_planes();
    ultragray_plan plan{};
    for (int d = 0; d < 3; ++d) {
        for (int axis = 0; axis < 3; ++axis) plan.axes[axis][d] = view.pose[4 * d + axis];
        plan.origin[d] = view.pose[4 * d + 3];
    }
    plan.near_cm = probe.near, plan.row_cm = (probe.far - probe.near) / height_, plan.most_cm = probe.cull_far;
    plan.start = probe.start, plan.span = probe.span;
    plan.beam[0] = probe.beam.at_focus, plan.beam[1] = probe.beam.focus;
    plan.beam[2] = probe.beam.slope2, plan.beam[3] = probe.beam.most;
    plan.fanned = probe.fanned, plan.wrap = probe.wrap;
    plan.height = height_, plan.width = width_;
    plan.bmode = !planes.bmode.empty(), plan.echo = !planes.echo.empty();
    plan.transmittance = !planes.transmittance.empty(), plan.coverage = !planes.coverage.empty();
    return plan;
}

void View::finish(const double* pose, const float* drawn, int threads, void* pixels) const {
    const Pose place = Pose::read(pose, "pose");
    Planes planes = wanted_planes();
    for (std::vector<float>* plane : {&planes.bmode, &planes.echo, &planes.transmittance, &planes.coverage}) {
        std::copy_n(drawn, plane->size(), plane->data());
        drawn += plane->size();
    }
    finish(place, kernel_view(place), planes, threads, static_cast<unsigned char*>(pixels));
}

bool View::asks_for(const char* output) const {
    return std::find(settings_.outputs.begin(), settings_.outputs.end(), output) != settings_.outputs.end();
}

// Room for the planes that the outputs follow from, and for those that tools and ghosts do.
Planes View::wanted_planes() const {
    const size_t size = size_t(height_) * width_;
    const bool beam = asks_for("transmittance") || asks_for("attenuation");
    const bool ghosts = settings_.ghost.value_or(0.0) > 0.0 && (beam || asks_for("bmode") || asks_for("echo"));
    const bool tools = settings_.tools && !settings_.tools->empty() && asks_for("bmode");
    Planes planes;
    if (ghosts || asks_for("bmode")) planes.bmode.resize(size);
    if (ghosts || asks_for("echo")) planes.echo.resize(size);
    if (ghosts || tools || beam) planes.transmittance.resize(size);
    if (asks_for("coverage")) planes.coverage.resize(size);
    return planes;
}

View::KernelView View::kernel_view(const Pose& pose) const {
    KernelView view;
    const Pose at_rest = scene_->tissue ? scene_->tissue->at_rest(pose) : pose;
    probe_.kernel_pose(at_rest, scene_->scene.info.centre_mm, view.pose);
    view.probe = probe_.kernel(height_, beam_);
    return view;
}

// From planes to pixels.
void View::finish(const Pose& pose, const KernelView& view, Planes& drawn, int threads, unsigned char* pixels) const {
    const size_t size = size_t(height_) * width_;
    const ScanView seen(probe_, pose, width_, beam_);
    const ToolsInView tools(settings_.tools.value_or(std::vector<Tool>{}), seen, height_);
    tools.draw(drawn);
    const double ghost = settings_.ghost.value_or(0.0);
    if (ghost > 0.0 && !drawn.echo.empty() && !drawn.bmode.empty()) add_ghosts(drawn, probe_, height_, width_, ghost);
    std::vector<float> taken(asks_for("attenuation") ? size : 0);  // the share of the beam that ends in a pixel
    for (size_t k = 0; k < taken.size(); ++k) {
        const float above = k < size_t(width_) ? 1.0f : drawn.transmittance[k - width_];
        const float share = 1.0f - drawn.transmittance[k] / std::max(above, kSpentBeam);
        taken[k] = above >= kSpentBeam ? std::clamp(share, 0.0f, 1.0f) : 0.0f;
    }
    for (const std::string& output : settings_.outputs) {
        std::vector<float> plane = output == "bmode"           ? drawn.bmode
                                   : output == "echo"          ? drawn.echo
                                   : output == "transmittance" ? drawn.transmittance
                                   : output == "coverage"      ? drawn.coverage
                                   : output == "attenuation"   ? taken
                                                               : labels(view, threads);
        if (is_numbers(output)) tools.mark(plane);
        put(output, plane, pixels);
        const bool bytes = is_numbers(output) || settings_.encoding == Encoding::Uint8;
        pixels += size_t(picture_.height) * picture_.width * (bytes ? 1 : sizeof(float));
    }
}

// The label whose Gaussians weigh most at each pixel; 0 where none weighs 1/255. Of equals the smallest is taken.
std::vector<float> View::labels(const KernelView& view, int threads) const {
    const size_t size = size_t(height_) * width_;
    std::vector<float> found(size), heaviest(size), weight(size);
    for (const auto& [label, part] : scene_->scene.parts) {
        ultragray::render(*part, view.probe, view.pose, 1, height_, width_, threads, "auto",
                          {nullptr, nullptr, nullptr, nullptr, weight.data(), nullptr, nullptr, nullptr, 0.0f}, {});
        for (size_t k = 0; k < size; ++k)
            if (weight[k] > heaviest[k] && weight[k] >= kLeastWeightSum) heaviest[k] = weight[k], found[k] = float(label);
    }
    return found;
}

// Shows a plane as the display settings want it: those of tone change B-mode alone.
void View::put(const std::string& output, std::vector<float>& plane, unsigned char* pixels) const {
    plane.resize(size_t(rows_) * width_);
    if (output == "bmode" && !lift_.empty()) set_tone(plane);
    if (output == "bmode" && display_.edge > 0.0) sharpen(plane);
    const int height = picture_.height, width = picture_.width;
    const bool nearest = is_numbers(output);
    for (int row = 0; row < height; ++row) {
        for (int column = 0; column < width; ++column) {
            const size_t place = size_t(row) * width + (display_.flip ? width - 1 - column : column);
            float value;
            if (samples_.empty()) {
                value = plane[place];
            } else {
                const Sample& s = samples_[place];
                const float* p = &plane[s.at];
                const float upper = p[0] + (p[s.beside] - p[0]) * s.right;
                const float lower = p[s.below] + (p[s.below + s.beside] - p[s.below]) * s.right;
                value = !s.inside ? 0.0f : nearest ? plane[s.nearest] : upper + (lower - upper) * s.down;
            }
            const size_t to = size_t(row) * width + column;
            if (nearest)
                pixels[to] = static_cast<unsigned char>(value);
            else if (settings_.encoding == Encoding::Uint8)
                pixels[to] = rounded(value);
            else
                std::memcpy(pixels + to * sizeof value, &value, sizeof value);
        }
    }
}

// Grey levels of each echo raised by its gain: 0 dB is white, the dynamic range below it black.
void View::set_tone(std::vector<float>& bmode) const {
    const float scale = float(kFrameRangeDb / display_.dynamic_range_db);
    for (size_t k = 0; k < bmode.size(); ++k) bmode[k] = std::clamp(bmode[k] * scale + lift_[k / width_], 0.0f, 1.0f);
}

// Unsharp masking by the mean of 3x3 samples; at the border the outermost ones count twice.
void View::sharpen(std::vector<float>& bmode) const {
    const std::vector<float> before = bmode;
    const float edge = float(display_.edge);
    for (int row = 0; row < rows_; ++row) {
        for (int column = 0; column < width_; ++column) {
            float sum = 0;
            for (int r = row - 1; r <= row + 1; ++r)
                for (int c = column - 1; c <= column + 1; ++c)
                    sum += before[size_t(std::clamp(r, 0, rows_ - 1)) * width_ + std::clamp(c, 0, width_ - 1)];
            float& pixel = bmode[size_t(row) * width_ + column];
            pixel = std::clamp(pixel + edge * (pixel - sum / 9.0f), 0.0f, 1.0f);
        }
    }
}

// Where each pixel of the scan-converted picture lies in the frame; those beyond its outer pixels show these.
std::vector<View::Sample> View::samples() const {
    const Probing shown = probe_.ending_at(probe_.near_mm + double(rows_) / height_ * probe_.length_mm());
    std::vector<Sample> found;
    for (int row = 0; row < picture_.height; ++row) {
        for (int column = 0; column < picture_.width; ++column) {
            const double x = picture_.first[0] + picture_.step[0] * column, z = picture_.first[1] + picture_.step[1] * row;
            const Place place = shown.place(x, z);
            const double down = (place.depth - shown.near_mm) / shown.length_mm();
            const double across = (place.across - shown.start()) / shown.span;
            if (!(down >= 0.0 && down <= 1.0 && across >= 0.0 && across <= 1.0)) {
                found.push_back({0, 0, 0, 0, 0.0f, 0.0f, false});
                continue;
            }
            const double i = std::clamp(down * rows_ - 0.5, 0.0, rows_ - 1.0);
            double j = across * width_ - 0.5;
            if (!shown.wraps()) j = std::clamp(j, 0.0, width_ - 1.0);
            const int top = int(std::floor(i)), left = (int(std::floor(j)) + width_) % width_;
            const int nearest = int(std::nearbyint(i)) * width_ + (int(std::nearbyint(j)) + width_) % width_;
            found.push_back({top * width_ + left, top < rows_ - 1 ? width_ : 0, left < width_ - 1 ? 1 : 1 - width_, nearest,
                             float(i - std::floor(i)), float(j - std::floor(j)), true});
        }
    }
    return found;
}

}  // namespace ultragray::library
