#include "frames.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "../kernels/render.hpp"
#include "../kernels/stiffness.hpp"

namespace ultragray::library {
namespace {

constexpr double kFrameRangeDb = 60.0;
constexpr float kLeastWeightSum = 1.0f / 255.0f;  // a label with less is not seen
constexpr float kSpentBeam = 1e-4f;               // nothing can be said of what is taken from less
const std::vector<std::string> kOutputs = {"bmode",       "echo",   "transmittance", "coverage",
                                           "attenuation", "labels", "uncertainty"};

bool is_numbers(const std::string& output) { return output == "labels"; }
bool tells_support(const std::string& output) { return output == "coverage" || output == "uncertainty"; }

// The name of an encoding, and the bytes of a pixel; 0 for one that is left to a service.
std::pair<const char*, size_t> stored_as(Encoding encoding) {
    switch (encoding) {
        case Encoding::Uint8:
            return {"uint8", 1};
        case Encoding::Float16:
            return {"float16", 2};
        case Encoding::Float32:
            return {"float32", 4};
        case Encoding::Png:
        case Encoding::Jpeg:
        case Encoding::Npz:
            return {"", 0};
    }
    throw Fault("there is no such encoding");
}

// What this library leaves to a service.
void check_local(const RenderSettings& settings, const SceneInfo& info) {
    const auto refuse = [](const std::string& field, const std::string& reason) { throw Fault(field + " " + reason); };
    if (settings.registration) refuse("registration", "is kept by a service: local poses are probe to scene");
    if (stored_as(settings.encoding).second == 0) refuse("encoding", "must be uint8, float32 or float16 for local frames");
    if (settings.min_confidence && !info.confidence)
        refuse("min_confidence", "needs a scene that knows the confidence of its frames; this one was trained without");
    if (settings.speckle == Speckle::Natural && !info.speckle)
        refuse("speckle", "natural needs a scene whose training fitted the speckle of its frames; this one has none");
    for (const std::string& output : settings.outputs) {
        if (std::find(kOutputs.begin(), kOutputs.end(), output) == kOutputs.end())
            refuse("outputs", "must be some of " + joined(kOutputs) + ", got '" + output + "'");
        if (is_numbers(output) && info.label_names.empty() && (!settings.tools || settings.tools->empty()))
            refuse("outputs", "may name labels only for a scene whose Gaussians carry labels, or for frames with tools");
        if (output == "uncertainty" && !(info.confidence && info.confidence->uncertainty))
            refuse("outputs",
                   "may name uncertainty only for a scene whose training fitted its uncertainty; this one has none");
    }
}

RenderSettings settings_of(const std::string& text, const SceneInfo& info) {
    const Json document = Json::parse(text.empty() ? "{}" : text, nullptr, false);
    if (document.is_discarded()) throw Fault("the settings are no JSON");
    RenderSettings settings = read_object<RenderSettings>(Value(document, ""));
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

// A frame whose confidence is not known has none.
bool is_confident(const Extrapolation& found, const std::optional<double>& least) {
    return !least || (std::isnan(found.confidence) ? 0.0 : found.confidence) >= *least;
}

int rows_shown(const Display& display, const Probing& probe, int height) {
    if (!display.depth_mm) return height;
    const double share = (probe.face_mm + *display.depth_mm - probe.near_mm) / probe.length_mm();
    return std::max(1, int(std::nearbyint(height * std::min(share, 1.0))));
}

unsigned char rounded(float value) {
    return static_cast<unsigned char>(std::nearbyint(std::clamp(value, 0.0f, 1.0f) * 255.0f));
}

// The nearest of the 16 bits of IEEE 754, of two the even one, of a number from 0 to 65504.
uint16_t halved(float value) {
    constexpr float kLeastNormal = 1.0f / 16384.0f, kSubnormals = 16777216.0f;
    if (value < kLeastNormal) return uint16_t(std::nearbyint(value * kSubnormals));
    uint32_t bits;
    std::memcpy(&bits, &value, sizeof bits);
    return uint16_t((bits + 0xfff + (bits >> 13 & 1) - (uint32_t(127 - 15) << 23)) >> 13);
}

// A step of SplitMix64 (G. Steele et al. 2014): 64 bits, each of which depends on all of a word.
uint64_t mixed(uint64_t word) {
    word += 0x9e3779b97f4a7c15;
    word = (word ^ word >> 30) * 0xbf58476d1ce4e5b9;
    word = (word ^ word >> 27) * 0x94d049bb133111eb;
    return word ^ word >> 31;
}

// Two numbers from 0 to 1 that follow from seed and pose, as Display.of_frame draws them: of gain and dynamic range.
std::array<double, 2> drawn_shares(uint64_t state, const Pose& pose) {
    const auto take = [&](double number) {
        uint64_t bits;
        number += 0.0;  // -0 is 0
        std::memcpy(&bits, &number, sizeof bits);
        state = mixed(state ^ bits);
    };
    for (int i = 0; i < 3; ++i) {
        for (const double one : pose.turn[i]) take(one);
        take(pose.origin[i]);
    }
    std::array<double, 2> shares;
    for (double& share : shares) share = double((state = mixed(state)) >> 11) / 9007199254740992.0;
    return shares;
}

}  // namespace

LoadedScene::LoadedScene(Scene read) : scene(std::move(read)) {
    const SceneInfo& info = scene.info;
    if (info.tissue_shares) tissue_ = std::make_unique<FollowingTissue>(scene);
    if (info.speckle) speckle = std::make_unique<SpeckleOfScene>(*info.speckle, poses_at_rest());
    if (!info.probe || scene.training_poses.empty()) return;
    views = std::make_unique<TrainingViews>(training_views(scene.training_poses, Probing::of(*info.probe)));
    views_at_rest = std::make_unique<TrainingViews>(training_views(poses_at_rest(), Probing::of(*info.probe)));
}

const Skin& LoadedScene::skin() const {
    const std::lock_guard<std::mutex> guard(lock_);
    if (!skin_) skin_ = std::make_unique<Skin>(scene.training_poses, scene.info.probe);
    return *skin_;
}

std::shared_ptr<const Compliance> LoadedScene::compliance() const {
    const std::lock_guard<std::mutex> guard(lock_);
    if (compliance_) return compliance_;
    std::vector<float> means;
    std::vector<uint8_t> labels;
    for (const auto& [label, part] : scene.parts) {
        const SceneView some = part->view();
        for (int64_t i = 0; i < some.count; ++i) {
            for (int d = 0; d < 3; ++d)
                means.push_back(float(10.0 * double(some.gaussians[i].mean[d]) + scene.info.centre_mm[d]));
            labels.push_back(uint8_t(label));
        }
    }
    std::array<float, 256> by_label;
    by_label.fill(float(1.0 / stiffness_kpa("")));
    for (const auto& [label, name] : scene.info.label_names) by_label[label] = float(1.0 / stiffness_kpa(name));
    compliance_ = std::make_shared<const Compliance>(means.data(), means.empty() ? nullptr : labels.data(),
                                                     int64_t(labels.size()), by_label.data());
    return compliance_;
}

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
    if (settings_.contact) scene_->skin();
    if (settings_.contact == Contact::Pressure) {
        std::vector<double> poses;
        for (const Pose& pose : scene_->poses_at_rest()) {
            const std::array<double, 16> matrix = pose.matrix();
            poses.insert(poses.end(), matrix.begin(), matrix.end());
        }
        const bool curved = probe_.is_angular() && probe_.face_mm > 0.0;
        const Face face{probe_.face_mm, probe_.breadth_mm(probe_.face_mm), curved, probe_.far_mm, probe_.half_width_mm()};
        press_ = std::make_unique<Press>(scene_->compliance(), face, poses.data(), int(poses.size() / 16));
    }
    if (settings_.speckle == Speckle::Natural)
        speckle_ = std::make_unique<SpeckleSamples>(scene_->speckle->model(), probe_, height_, width_);
    if (display_.flip) {
        picture_.first[0] += (picture_.width - 1) * picture_.step[0];
        picture_.step[0] = -picture_.step[0];
    }
    json_ = Json{{"outputs", settings_.outputs},
                 {"encoding", stored_as(settings_.encoding).first},
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

size_t View::bytes_per_pixel(const std::string& output) const {
    return is_numbers(output) ? 1 : stored_as(settings_.encoding).second;
}

size_t View::frame_bytes() const {
    size_t bytes = 0;
    for (const std::string& output : settings_.outputs) bytes += bytes_per_pixel(output);
    return bytes * size_t(picture_.height) * size_t(picture_.width);
}

void View::render(const double* poses, size_t count, int threads, void* pixels, Extrapolation* extrapolations) const {
    auto* out = static_cast<unsigned char*>(pixels);
    const bool judged = extrapolations != nullptr || settings_.min_confidence;
    for (size_t c = 0; c < count; ++c) {
        const Sight sight = sight_of(poses + 16 * c, "poses[" + std::to_string(c) + "]");
        Extrapolation found{};
        if (judged) found = judged_by_pose(sight);
        Planes planes = wanted_planes(judged);
        draw(sight, {}, threads, planes);
        finish(sight, planes, threads, judged ? &found : nullptr, out + c * frame_bytes());
        if (extrapolations) extrapolations[c] = found;
    }
}

void View::draw(const Sight& sight, const Lines& lines, int threads, Planes& planes) const {
    const auto at = [](std::vector<float>& plane) { return plane.empty() ? nullptr : plane.data(); };
    if (!at(planes.bmode) && !at(planes.echo) && !at(planes.transmittance) && !at(planes.coverage)) return;
    ultragray::render(*scene_->scene.gaussians, sight.geometry, sight.matrix, 1, height_, width_, threads, "auto",
                      {at(planes.bmode), at(planes.echo), at(planes.transmittance), at(planes.coverage), nullptr, nullptr,
                       nullptr, nullptr, 0.0f},
                      {}, lines, sight.displacements(scene_->scene.info.centre_mm));
}

void View::draw(const double* pose, int first_line, int end_line, float* drawn) const {
    const bool ends_a_strip = end_line % kStripLines == 0 || end_line == width_;
    if (first_line < 0 || first_line % kStripLines != 0 || !ends_a_strip || first_line >= end_line || end_line > width_)
        throw Fault("scan lines must be some of " + std::to_string(width_) + ", from one multiple of " +
                    std::to_string(kStripLines) + " to another or to the last, got " + std::to_string(first_line) + " to " +
                    std::to_string(end_line));
    Planes planes = wanted_planes(true);
    draw(sight_of(pose, "pose"), {first_line, end_line}, 1, planes);
    for (const std::vector<float>* plane : planes.all())
        for (size_t at = first_line; at < plane->size(); at += width_)
            drawn = std::copy_n(&(*plane)[at], end_line - first_line, drawn);
}

ultragray_plan View::plan(const double* pose) const {
    const Sight sight = sight_of(pose, "pose");
    const ProbeGeometry& probe = sight.geometry;
    const Planes planes = wanted_planes(true);
    ultragray_plan plan{};
    for (int d = 0; d < 3; ++d) {
        for (int axis = 0; axis < 3; ++axis) plan.axes[axis][d] = sight.matrix[4 * d + axis];
        plan.origin[d] = sight.matrix[4 * d + 3];
    }
    plan.near_cm = probe.near, plan.row_cm = (probe.far - probe.near) / height_, plan.most_cm = probe.cull_far;
    plan.start = probe.start, plan.span = probe.span;
    plan.beam[0] = probe.beam.at_focus, plan.beam[1] = probe.beam.focus;
    plan.beam[2] = probe.beam.slope2, plan.beam[3] = probe.beam.most;
    plan.fanned = probe.fanned, plan.wrap = probe.wrap;
    plan.height = height_, plan.width = width_;
    plan.bmode = !planes.bmode.empty(), plan.echo = !planes.echo.empty();
    plan.transmittance = !planes.transmittance.empty(), plan.coverage = !planes.coverage.empty();
    plan.displaced = sight.pressed.has_value();
    return plan;
}

Extrapolation View::finish(const double* pose, const float* drawn, int threads, void* pixels) const {
    const Sight sight = sight_of(pose, "pose");
    Extrapolation found = judged_by_pose(sight);
    Planes planes = wanted_planes(true);
    for (std::vector<float>* plane : planes.all()) {
        std::copy_n(drawn, plane->size(), plane->data());
        drawn += plane->size();
    }
    finish(sight, planes, threads, &found, static_cast<unsigned char*>(pixels));
    return found;
}

bool View::asks_for(const char* output) const {
    return std::find(settings_.outputs.begin(), settings_.outputs.end(), output) != settings_.outputs.end();
}

Sight View::sight_of(const double* matrix, const std::string& name) const {
    const Pose pose = Pose::read(matrix, name);
    Sight sight{name, pose, scene_->at_rest(pose), probe_.kernel(height_, beam_), {}, {}, {}};
    if (settings_.contact) sight.touch.emplace(scene_->skin(), probe_, pose, width_);
    if (press_) press(sight);
    const Vector& centre = scene_->scene.info.centre_mm;
    Pose inside = sight.at_rest;  // by way of the kernels' own frame, cm about the scene's centre, as Python goes it
    inside.origin = times(minus(inside.origin, centre), 1.0 / 10.0);
    sight.at_rest.origin = plus(times(inside.origin, 10.0), centre);
    probe_.kernel_pose(inside, sight.matrix);
    return sight;
}

// How the face and needles displace the tissue (ultragray.rendering.pressing).
void View::press(Sight& sight) const {
    std::vector<double> depths = sight.touch->depths_mm;
    if (settings_.indentation_mm)
        std::fill(depths.begin(), depths.end(), sight.touch->count ? *settings_.indentation_mm : 0.0);
    double sum = 0;
    for (size_t j = 0; j < depths.size(); ++j) sum += sight.touch->lines[j] ? depths[j] : 0.0;
    std::vector<Shaft> needles;
    const ScanView seen(probe_, sight.pose, 1, beam_);
    for (const Tool& tool : settings_.tools.value_or(std::vector<Tool>{}))
        if (const auto* needle = std::get_if<Needle>(&tool)) {
            const Vector tip = seen.seen(needle->frame, needle->tip_mm), hub = seen.seen(needle->frame, needle->hub_mm);
            needles.push_back({{tip[0], tip[1], tip[2]}, {hub[0], hub[1], hub[2]}});
        }
    sight.indentation_mm = sum / std::max(sight.touch->count, 1), sight.force_n = 0.0;
    if (sum == 0.0 && needles.empty()) return;
    sight.pressed = press_->at(sight.at_rest.matrix().data(), depths.data(), width_, needles);
    sight.force_n = sight.pressed->force_n;
}

Displacements Sight::displacements(const Vector& centre_mm) const {
    if (!pressed) return {};
    const auto& [coefficients, size, to_grid, force] = *pressed;
    return {{coefficients.data(), to_grid.data(), {size[0], size[1], size[2]}, false, false, centre_mm}};
}

// Room for the planes that the outputs follow from, and for those that tools, ghosts and confidence do.
Planes View::wanted_planes(bool judged) const {
    const size_t size = size_t(height_) * width_;
    const bool uncertain = asks_for("uncertainty"), bmode = asks_for("bmode") || uncertain;
    const bool beam = asks_for("transmittance") || asks_for("attenuation") || uncertain;
    const bool ghosts = settings_.ghost.value_or(0.0) > 0.0 && (beam || bmode || asks_for("echo"));
    const bool tools = settings_.tools && !settings_.tools->empty() && bmode;
    Planes planes;
    if (ghosts || bmode) planes.bmode.resize(size);
    if (ghosts || asks_for("echo")) planes.echo.resize(size);
    if (ghosts || tools || beam) planes.transmittance.resize(size);
    if (asks_for("coverage") || uncertain || judged) planes.coverage.resize(size);
    return planes;
}

void View::finish(const Sight& sight, Planes& drawn, int threads, Extrapolation* judged, unsigned char* pixels) const {
    const ScanView seen(probe_, sight.pose, width_, beam_);
    const ToolsInView tools(settings_.tools.value_or(std::vector<Tool>{}), seen, height_);
    tools.draw(drawn);
    // No beam gets out along a scan line without contact.
    const auto leave_heard = [&](std::vector<float>& plane) {
        for (size_t k = 0; sight.touch && k < plane.size(); ++k)
            if (!sight.touch->lines[k % width_]) plane[k] = 0.0f;
    };
    leave_heard(drawn.bmode), leave_heard(drawn.transmittance);
    const double ghost = settings_.ghost.value_or(0.0);
    if (ghost > 0.0 && !drawn.echo.empty() && !drawn.bmode.empty()) add_ghosts(drawn, probe_, height_, width_, ghost);

    bool masked = false;
    if (judged) {
        const auto supported = std::count_if(drawn.coverage.begin(), drawn.coverage.end(),
                                             [](float coverage) { return coverage >= kSupportCoverage; });
        add_support(*judged, scene_->confidence(), float(supported) / float(drawn.coverage.size()));
        if (sight.touch) judged->contact_share = double(sight.touch->count) / width_;
        judged->indentation_mm = sight.indentation_mm, judged->force_n = sight.force_n;
        require_confidence(sight, *judged);
        masked = settings_.below_min_confidence == Below::Mask && !is_confident(*judged, settings_.min_confidence);
    }
    for (const std::string& output : settings_.outputs) {
        std::vector<float> plane = output == "bmode"           ? drawn.bmode
                                   : output == "echo"          ? drawn.echo
                                   : output == "transmittance" ? drawn.transmittance
                                   : output == "coverage"      ? drawn.coverage
                                   : output == "attenuation"   ? attenuation(drawn.transmittance)
                                   : output == "uncertainty"   ? uncertainty(sight, drawn)
                                                               : labels(sight, threads);
        if (is_numbers(output)) tools.mark(plane);
        if (output == "bmode" && speckle_) {
            plane = scene_->speckle->added(plane, *speckle_, sight.at_rest, threads);
            leave_heard(plane);
        }
        plane.resize(size_t(rows_) * width_);
        if (output == "bmode") set_tone(plane, sight.pose);
        if (output == "bmode" && display_.edge > 0.0) sharpen(plane);
        for (size_t k = 0; masked && !tells_support(output) && k < plane.size(); ++k)
            if (drawn.coverage[k] < kSupportCoverage) plane[k] = 0.0f;
        put(output, plane, pixels);
        pixels += size_t(picture_.height) * picture_.width * bytes_per_pixel(output);
    }
}

Extrapolation View::judged_by_pose(const Sight& sight) const {
    const Extrapolation found = assess(scene_->views.get(), scene_->confidence(), sight.pose, probe_);
    require_confidence(sight, found);
    return found;
}

void View::require_confidence(const Sight& sight, const Extrapolation& found) const {
    if (settings_.below_min_confidence == Below::Mask || is_confident(found, settings_.min_confidence)) return;
    char text[320];
    int length = std::snprintf(text, sizeof text, "%s has a confidence of %.2f, %g is asked for", sight.name.c_str(),
                               std::isnan(found.confidence) ? 0.0 : found.confidence, *settings_.min_confidence);
    if (!std::isnan(found.distance_mm))
        length += std::snprintf(text + length, sizeof text - length,
                                ": the nearest training views are %.1f mm and %.1f degrees away", found.distance_mm,
                                found.angle_deg);
    if (!std::isnan(found.supported_share))
        std::snprintf(text + length, sizeof text - length, "; Gaussians support %.0f%% of its pixels",
                      100.0 * found.supported_share);
    throw Fault(text);
}

// The share of the beam that ends in a pixel.
std::vector<float> View::attenuation(const std::vector<float>& transmittance) const {
    std::vector<float> taken;
    for (size_t k = 0; k < transmittance.size(); ++k) {
        const float above = k < size_t(width_) ? 1.0f : transmittance[k - width_];
        const float share = 1.0f - transmittance[k] / std::max(above, kSpentBeam);
        taken.push_back(above >= kSpentBeam ? std::clamp(share, 0.0f, 1.0f) : 0.0f);
    }
    return taken;
}

std::vector<float> View::uncertainty(const Sight& sight, const Planes& drawn) const {
    const ViewMeasures measures = measure(*scene_->views_at_rest, sight.at_rest, probe_, kUncertaintyPoints);
    return deviations(*scene_->confidence()->uncertainty, measures, {drawn.bmode, drawn.coverage, drawn.transmittance},
                      height_, width_);
}

// The label whose Gaussians weigh most at each pixel; 0 where none weighs 1/255. Of equals the smallest is taken.
std::vector<float> View::labels(const Sight& sight, int threads) const {
    const size_t size = size_t(height_) * width_;
    std::vector<float> found(size), heaviest(size), weight(size);
    for (const auto& [label, part] : scene_->scene.parts) {
        ultragray::render(*part, sight.geometry, sight.matrix, 1, height_, width_, threads, "auto",
                          {nullptr, nullptr, nullptr, nullptr, weight.data(), nullptr, nullptr, nullptr, 0.0f}, {}, {},
                          sight.displacements(scene_->scene.info.centre_mm));
        for (size_t k = 0; k < size; ++k)
            if (weight[k] > heaviest[k] && weight[k] >= kLeastWeightSum) heaviest[k] = weight[k], found[k] = float(label);
    }
    return found;
}

// Shows a plane [rows, W] as the picture has it, in the encoding.
void View::put(const std::string& output, const std::vector<float>& plane, unsigned char* pixels) const {
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
            if (nearest) {
                pixels[to] = static_cast<unsigned char>(value);
            } else if (settings_.encoding == Encoding::Uint8) {
                pixels[to] = rounded(value);
            } else if (settings_.encoding == Encoding::Float16) {
                const uint16_t half = halved(value);
                std::memcpy(pixels + to * sizeof half, &half, sizeof half);
            } else {
                std::memcpy(pixels + to * sizeof value, &value, sizeof value);
            }
        }
    }
}

// Grey levels of each echo raised by its gain: 0 dB is white, the dynamic range below it black. Where they are drawn at
// random the pose decides.
void View::set_tone(std::vector<float>& bmode, const Pose& pose) const {
    double gain = display_.gain_db, range = display_.dynamic_range_db;
    const std::vector<double>&gains = display_.gain_db_between, &ranges = display_.dynamic_range_db_between,
          &points = display_.tgc_db;
    if (!gains.empty() || !ranges.empty()) {
        const auto [first, second] = drawn_shares(uint64_t(display_.display_seed), pose);
        if (!gains.empty()) gain = gains[0] + first * (gains[1] - gains[0]);
        if (!ranges.empty()) range = ranges[0] + second * (ranges[1] - ranges[0]);
    }
    const bool by_depth = std::any_of(points.begin(), points.end(), [](double one) { return one != 0.0; });
    if (gain == 0.0 && range == kFrameRangeDb && !by_depth) return;
    const float scale = float(kFrameRangeDb / range);
    for (int row = 0; row < rows_; ++row) {
        double here = gain;
        if (by_depth) {
            const double place = (row + 0.5) / rows_ * double(points.size() - 1);
            const size_t low = std::min(size_t(place), points.size() - 1), high = std::min(low + 1, points.size() - 1);
            here += points[low] + (place - double(low)) * (points[high] - points[low]);
        }
        const float lift = float(1.0 - kFrameRangeDb / range) + float(here) / float(range);
        for (float* pixel = &bmode[size_t(row) * width_]; pixel != &bmode[size_t(row) * width_] + width_; ++pixel)
            *pixel = std::clamp(*pixel * scale + lift, 0.0f, 1.0f);
    }
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
