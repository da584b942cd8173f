#include "render.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <limits>
#include <memory>
#include <new>
#include <stdexcept>

#include "footprint.hpp"
#include "threads.hpp"

namespace ultragray {
namespace {

constexpr int64_t kClustersPerTask = 128;
constexpr int kPosesAtOnce = 8;                    // bounds the memory that slices take
constexpr int64_t kPixelsBetweenChecks = 1 << 21;  // of the flag that ends a rendering: at most some 10 ms

std::vector<const Kernels*> available_kernels() {
    std::vector<const Kernels*> found;
#if defined(ULTRAGRAY_X86)
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
        __builtin_cpu_supports("avx512bw"))
        found.push_back(&kernels_avx512());
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) found.push_back(&kernels_avx2());
#endif
    found.push_back(&kernels_baseline());
    return found;
}

// Scan lines in the image plane, padded so that a vector may start at any of them.
struct ScanLines {
    std::vector<double> x, dir_x, dir_z;

    ScanLines(const ProbeGeometry& probe, int width) {
        for (int j = 0; j < width + kMaxLanes; ++j) {
            const double across = probe.start + probe.span * ((std::min(j, width - 1) + 0.5) / width);
            x.push_back(probe.fanned ? 0.0 : across);
            dir_x.push_back(probe.fanned ? std::sin(across) : 0.0);
            dir_z.push_back(probe.fanned ? std::cos(across) : 1.0);
        }
    }
};

View make_view(const ProbeGeometry& probe, const ScanLines& lines, const double* pose, int height, int width, bool absorbs) {
    View view{};
    for (int axis = 0; axis < 3; ++axis) {
        for (int d = 0; d < 3; ++d) view.axes[axis][d] = pose[4 * d + axis];
        view.origin[axis] = pose[4 * axis + 3];
    }
    view.line_x = lines.x.data(), view.dir_x = lines.dir_x.data(), view.dir_z = lines.dir_z.data();
    if (!probe.fanned)
        for (int k = 0; k < kMaxLanes; ++k) view.spacing[k] = static_cast<float>(k * probe.span / width);
    view.near = probe.near;
    view.cull_near = probe.uncut ? -std::numeric_limits<double>::infinity() : probe.near;
    view.cull_far = probe.uncut ? std::numeric_limits<double>::infinity() : probe.cull_far;
    view.row_step = (probe.far - probe.near) / height;
    view.start = probe.start, view.span = probe.span, view.fanned = probe.fanned, view.wrap = probe.wrap;
    view.height = height, view.lines = width;
    view.beam = probe.beam;
    view.absorbs = absorbs;
    return view;
}

// One allocation of the four accumulators of a strip.
class StripBuffer {
 public:
    StripBuffer(int height, int lines) : stride_(lines + kMaxLanes), rows_(height) {
        floats_ = static_cast<float*>(::operator new(4 * plane() * sizeof(float), std::align_val_t(64)));
    }
    ~StripBuffer() { ::operator delete(floats_, std::align_val_t(64)); }
    StripBuffer(const StripBuffer&) = delete;
    StripBuffer& operator=(const StripBuffer&) = delete;

    Strip clear(int first, int lines) {
        std::fill_n(floats_, 2 * plane(), 0.0f);
        std::fill_n(floats_ + 2 * plane(), 2 * plane(), 1.0f);
        return {floats_, floats_ + plane(), floats_ + 2 * plane(), floats_ + 3 * plane(), stride_, first, lines};
    }

 private:
    int64_t plane() const { return int64_t(stride_) * rows_; }
    int stride_, rows_;
    float* floats_;
};

// Some poses on their way from Gaussians to pixels.
class Batch {
 public:
    Batch(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count, int height, int width,
          const Kernels& kernels)
        : kernels_(kernels), scene_(scene.view()), lines_(probe, width) {
        for (int c = 0; c < count; ++c)
            views_.push_back(make_view(probe, lines_, poses + 16 * c, height, width, !scene_.weighted));
        slices_ = std::vector<SliceList>(int64_t(count) * parts());
    }
    Batch(const Batch&) = delete;
    Batch& operator=(const Batch&) = delete;

    // `first` is the number of the first pose, for errors. Throws GivenUp, TooCostly.
    void render(const Outputs& outputs, const std::vector<SavedPlanes>& saved, int threads, const Limits& limits = {},
                int first = 0, const Lines& drawn = {}) {
        const int first_strip = drawn.first / kStripLines, end = std::min(drawn.end, views_[0].lines);
        const int strips = (end + kStripLines - 1) / kStripLines - first_strip;
        Phase slicing{count() * parts(), [&](int task) { slice(task, limits); }};
        Phase checking{count(), [&](int c) {
                           const auto& most = limits.footprint_pixels;
                           if (sum(c, footprint_bound) <= most) return;
                           const int64_t pixels = sum(c, footprint_pixels);
                           if (pixels > most) throw TooCostly(first + c, pixels);
                       }};
        Phase drawing{count() * strips, [&](int task) {
                          const int c = task / strips, line = (first_strip + task % strips) * kStripLines;
                          draw(c, line, outputs, saved.empty() ? SavedPlanes{} : saved[c], limits);
                      }};
        run_phases({&slicing, &checking, &drawing}, threads);
    }

    // The cost of each pose, without drawing.
    void footprints(int64_t* pixels, int threads, const Limits& limits) {
        Phase slicing{count() * parts(), [&](int task) { slice(task, limits); }};
        Phase summing{count(), [&](int c) { pixels[c] = sum(c, footprint_pixels); }};
        run_phases({&slicing, &summing}, threads);
    }

    // What drawing each strip takes: [poses, strips].
    std::vector<Work> work(int threads) {
        std::vector<Work> found(count() * strips());
        Phase slicing{count() * parts(), [&](int task) { slice(task, {}); }};
        Phase counting{count() * strips(), [&](int task) {
                           const View& view = views_[task / strips()];
                           const int first = task % strips() * kStripLines;
                           for (int part = 0; part < parts(); ++part) {
                               const SliceList& list = slices_[int64_t(task / strips()) * parts() + part];
                               kernels_.count(view, list.data(), list.size(), first,
                                              std::min(kStripLines, view.lines - first), found[task]);
                           }
                       }};
        run_phases({&slicing, &counting}, threads);
        return found;
    }

    // Gradients are added to; no two tasks share a Gaussian, and each adds in the order of the poses. Views add up their
    // parts in order, and so does the beam.
    BeamMoments differentiate(const std::vector<SavedPlanes>& saved, const Outputs& gradients,
                              const std::vector<PixelGradients>& pixels, GaussianGradient* gaussians, float* sh,
                              ViewGradient* views, int threads) const {
        std::vector<ViewGradient> by_part(views ? slices_.size() : 0);
        Phase by_pixel{count() * strips(), [&](int task) {
                           const int c = task / strips(), first = task % strips() * kStripLines;
                           const View& view = views_[c];
                           kernels_.differentiate(view, first, std::min(kStripLines, view.lines - first), saved[c],
                                                  gradients.from(c, frame_size()), pixels[c]);
                       }};
        std::vector<BeamMoments> moments(parts());
        Phase by_gaussian{parts(), [&](int part) {
                              for (int c = 0; c < count(); ++c) {
                                  const int64_t place = int64_t(c) * parts() + part;
                                  const SliceList& list = slices_[place];
                                  kernels_.gather(scene_, views_[c], list.data(), list.size(), pixels[c], gaussians, sh,
                                                  moments[part], views ? &by_part[place] : nullptr);
                              }
                          }};
        run_phases({&by_pixel, &by_gaussian}, threads);
        for (size_t place = 0; place < by_part.size(); ++place) {
            ViewGradient& sum = views[place / parts()];
            for (int d = 0; d < 3; ++d) {
                sum.shift[d] += by_part[place].shift[d];
                sum.turn[d] += by_part[place].turn[d];
            }
        }
        BeamMoments sum{};
        for (const BeamMoments& part : moments)
            sum.zeroth += part.zeroth, sum.first += part.first, sum.second += part.second;
        return sum;
    }

 private:
    int count() const { return static_cast<int>(views_.size()); }
    int parts() const { return static_cast<int>((scene_.cluster_count + kClustersPerTask - 1) / kClustersPerTask); }
    int strips() const { return (views_[0].lines + kStripLines - 1) / kStripLines; }
    int64_t frame_size() const { return int64_t(views_[0].height) * views_[0].lines; }

    void slice(int task, const Limits& limits) {
        limits.check_flag();
        const int64_t begin = task % parts() * kClustersPerTask;
        const int64_t end = std::min(begin + kClustersPerTask, scene_.cluster_count);
        kernels_.slice(scene_, views_[task / parts()], begin, end, slices_[task]);
    }

    int64_t sum(int c, int64_t (*pixels)(const View&, const SliceList&)) const {
        int64_t found = 0;
        for (int part = 0; part < parts(); ++part) found += pixels(views_[c], slices_[int64_t(c) * parts() + part]);
        return found;
    }

    void draw(int c, int first, const Outputs& outputs, const SavedPlanes& saved, const Limits& limits) const {
        const View& view = views_[c];
        thread_local std::unique_ptr<StripBuffer> buffer;
        thread_local int buffer_height = 0;
        if (!buffer || buffer_height != view.height) {
            buffer.reset();
            buffer = std::make_unique<StripBuffer>(view.height, kStripLines);
            buffer_height = view.height;
        }
        const int64_t at_once = std::max<int64_t>(1, kPixelsBetweenChecks / (int64_t(kStripLines) * view.height));
        const Strip strip = buffer->clear(first, std::min(kStripLines, view.lines - first));
        for (int part = 0; part < parts(); ++part) {
            const SliceList& list = slices_[int64_t(c) * parts() + part];
            for (int64_t i = 0; i < list.size(); i += at_once) {
                limits.check_flag();
                kernels_.draw(view, list.data() + i, std::min(at_once, list.size() - i), strip);
            }
        }
        kernels_.finish(view, strip, outputs.from(c, frame_size()), saved);
    }

    const Kernels& kernels_;
    const SceneView scene_;
    const ScanLines lines_;
    std::vector<View> views_;
    std::vector<SliceList> slices_;  // [poses, parts]
};

// `count` planes for each pose, side by side in one allocation.
class Planes {
 public:
    Planes(int poses, int count, int height, int stride) : plane_(int64_t(height) * stride), count_(count) {
        floats_.reset(new float[poses * count * plane_]);
    }
    float* at(int pose, int plane) const { return floats_.get() + (int64_t(pose) * count_ + plane) * plane_; }

 private:
    int64_t plane_;
    int count_;
    std::unique_ptr<float[]> floats_;
};

}  // namespace

SliceList::~SliceList() { std::free(data_); }

Slice* SliceList::append(int n) {
    if (size_ + n > capacity_) {
        const int64_t capacity = std::max<int64_t>(2 * capacity_, size_ + n + 1024);
        void* grown = std::realloc(data_, capacity * sizeof(Slice));
        if (grown == nullptr) throw std::bad_alloc();
        data_ = static_cast<Slice*>(grown);
        capacity_ = capacity;
    }
    size_ += n;
    return data_ + size_ - n;
}

void SliceList::shrink_by(int n) { size_ -= n; }

const Kernels& choose_kernels(const std::string& name) {
    static const std::vector<const Kernels*> available = available_kernels();
    for (const Kernels* kernels : available)
        if (name == "auto" || name == kernels->name) return *kernels;
    throw std::invalid_argument("this processor cannot run the instruction set " + name);
}

std::vector<std::string> instruction_sets() {
    std::vector<std::string> names;
    for (const Kernels* kernels : available_kernels()) names.push_back(kernels->name);
    return names;
}

void render(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count, int height, int width,
            int threads, const std::string& instruction_set, const Outputs& outputs, const Limits& limits,
            const Lines& drawn) {
    const Kernels& kernels = choose_kernels(instruction_set);
    const int64_t frame_size = int64_t(height) * width;
    for (int first = 0; first < count; first += kPosesAtOnce) {
        Batch batch(scene, probe, poses + 16 * first, std::min(kPosesAtOnce, count - first), height, width, kernels);
        batch.render(outputs.from(first, frame_size), {}, threads, limits, first, drawn);
    }
}

void footprints(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count, int height,
                int width, int threads, const std::string& instruction_set, const Limits& limits, int64_t* pixels) {
    const Kernels& kernels = choose_kernels(instruction_set);
    for (int first = 0; first < count; first += kPosesAtOnce) {
        Batch batch(scene, probe, poses + 16 * first, std::min(kPosesAtOnce, count - first), height, width, kernels);
        batch.footprints(pixels + first, threads, limits);
    }
}

std::vector<Work> drawing_work(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count,
                               int height, int width, int threads, const std::string& instruction_set) {
    if (count == 0) throw std::invalid_argument("there must be at least one pose");
    Batch batch(scene, probe, poses, count, height, width, choose_kernels(instruction_set));
    return batch.work(threads);
}

struct Recording::State {
    Batch batch;
    Planes planes;
    std::vector<SavedPlanes> saved;
    int stride;
};

Recording::Recording(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count, int height,
                     int width, int threads, const std::string& instruction_set, const Outputs& outputs)
    : scene_(scene), count_(count), height_(height), width_(width) {
    if (scene.order() == Order::Sorted) throw std::invalid_argument("a recording needs a scene in its given order");
    if (count == 0) return;
    const int stride = (width + kMaxLanes - 1) / kMaxLanes * kMaxLanes + kMaxLanes;
    state_.reset(new State{{scene, probe, poses, count, height, width, choose_kernels(instruction_set)},
                           {count, 3, height, stride},
                           {},
                           stride});
    const Planes& planes = state_->planes;
    for (int c = 0; c < count; ++c) state_->saved.push_back({planes.at(c, 0), planes.at(c, 1), planes.at(c, 2), stride});
    state_->batch.render(outputs, state_->saved, threads);
}

Recording::~Recording() = default;

int Recording::harmonics() const {
    const int degree = scene_.view().sh_degree;
    return (degree + 1) * (degree + 1);
}

BeamMoments Recording::differentiate(const Outputs& gradients, const RawGradients& out, ViewGradient* views,
                                     int threads) const {
    if (views) std::fill_n(views, count_, ViewGradient{});
    const SceneView scene = scene_.view();
    std::vector<GaussianGradient> gaussians(scene.count);
    std::vector<float> sh(scene.count * harmonics());
    BeamMoments moments{};
    if (state_) {
        const Planes planes(count_, 4, height_, state_->stride);
        std::vector<PixelGradients> pixels;
        for (int c = 0; c < count_; ++c)
            pixels.push_back({planes.at(c, 0), planes.at(c, 1), planes.at(c, 2), planes.at(c, 3), state_->stride});
        moments = state_->batch.differentiate(state_->saved, gradients, pixels, gaussians.data(), sh.data(), views, threads);
    }
    scene_.to_raw(gaussians.data(), sh.data(), out, threads);
    return moments;
}

}  // namespace ultragray
