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
constexpr float kMmPerCm = 10;
constexpr int kPosesAtOnce = 8;                    // bounds the memory that slices take
constexpr int kPosesShared = 64;                   // at once, where each thread draws poses of its own
constexpr int kPosesOfAThread = 8;                 // at least, so that none waits long for the last one
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

// The fields of some poses, packed as the kernels read them, with bounds of what they do.
class Fields {
 public:
    // Throws std::invalid_argument for more than kMaxFields, and grids with fewer than four coefficients along an axis.
    Fields(const Displacements& displacements, int first, int count) : each_(static_cast<int>(displacements.size())) {
        if (each_ > kMaxFields) throw std::invalid_argument("tissue may be displaced by at most 4 fields");
        for (const Displacement& one : displacements)
            if (*std::min_element(one.size, one.size + 3) < 4)
                throw std::invalid_argument("a field needs at least four coefficients along each axis");
        for (int c = 0; each_ && c < count; ++c)
            for (const Displacement& one : displacements) add(one, first + c);
    }

    // Only the displacement along elevation decides which Gaussians the plane may cut. Of the last field that is one
    // component; of those before it all count, as they choose where the last one is looked up.
    void apply(View& view, int c) {
        view.fields = fields_.data() + int64_t(c) * each_;
        view.field_count = each_;
        float steepest = 1;
        for (int f = 0; f < each_; ++f) {
            Field& field = fields_[int64_t(c) * each_ + f];
            layers_.push_back(layers_of(field, view.axes[1]));
            field.layers = layers_.back().data();
            field.steepest = f + 1 < each_ ? 1 + steepest_of(field) : 1;
            Layer all = field.layers[0];
            for (const Layer& one : layers_.back()) all.widen(one);
            view.displaced.least += all.least, view.displaced.most += all.most;
            view.displaced.gradient = steepest * (1 + all.gradient) - 1;
            view.displaced.stretch = steepest * all.stretch;
            steepest *= field.steepest;
        }
    }

    int each() const { return each_; }

 private:
    static constexpr float kRounding = 1 + 1e-5f;

    // Values of a spline are means of its four nodes along each axis, and its slopes of the differences of neighbours. The
    // axes of the grid are at right angles.
    static std::vector<Layer> layers_of(const Field& field, const double normal[3]) {
        const int depths = field.size[2];
        const int64_t columns = int64_t(field.size[0]) * field.size[1];
        std::vector<float> along(columns * depths);
        for (size_t i = 0; i < along.size(); ++i) {
            const float* node = field.coefficients + 4 * i;
            along[i] = float(normal[0]) * node[0] + float(normal[1]) * node[1] + float(normal[2]) * node[2];
        }
        std::vector<float> low(along.begin(), along.begin() + depths), high = low, steps[3];
        for (std::vector<float>& one : steps) one.assign(depths, 0.0f);
        const auto widen = [](std::vector<float>& most, const float* from, const float* to, int count) {
            for (int k = 0; k < count; ++k) {
                const float step = to[k] - from[k], square = step * step;
                most[k] = square > most[k] ? square : most[k];
            }
        };
        for (int64_t column = 0; column < columns; ++column) {
            const float* here = &along[column * depths];
            for (int k = 0; k < depths; ++k) {
                low[k] = here[k] < low[k] ? here[k] : low[k];
                high[k] = here[k] > high[k] ? here[k] : high[k];
            }
            if (column + field.size[1] < columns) widen(steps[0], here, here + field.size[1] * depths, depths);
            if ((column + 1) % field.size[1]) widen(steps[1], here, here + depths, depths);
            widen(steps[2], here, here + 1, depths - 1);
        }
        std::vector<Layer> layers(depths - 3);
        for (int k = 0; k < depths - 3; ++k) {
            Layer& layer = layers[k];
            layer.least = *std::min_element(&low[k], &low[k] + 4), layer.most = *std::max_element(&high[k], &high[k] + 4);
            double gradient = 0, stretch = 0;
            for (int a = 0; a < 3; ++a) {
                const double* row = field.to_grid[a];
                const double per_cm = std::sqrt(row[0] * row[0] + row[1] * row[1] + row[2] * row[2]);
                const double facing = std::abs(row[0] * normal[0] + row[1] * normal[1] + row[2] * normal[2]) / per_cm;
                const double slope = per_cm * std::sqrt(*std::max_element(&steps[a][k], &steps[a][k] + (a == 2 ? 3 : 4)));
                gradient += slope * slope, stretch += (facing + slope) * (facing + slope);
            }
            layer.gradient = float(std::sqrt(gradient)) * kRounding, layer.stretch = float(std::sqrt(stretch)) * kRounding;
        }
        return layers;
    }

    // Bound of the norm of a field's gradient.
    static float steepest_of(const Field& field) {
        double squares = 0;
        for (int a = 0; a < 3; ++a) {
            float longest = 0;
            double per_cm = 0;
            for (int e = 0; e < 3; ++e) per_cm += field.to_grid[a][e] * field.to_grid[a][e];
            const int end[3] = {field.size[0] - (a == 0), field.size[1] - (a == 1), field.size[2] - (a == 2)};
            const int64_t next = field.place(a == 0, a == 1, a == 2);
            for (int i = 0; i < end[0]; ++i)
                for (int j = 0; j < end[1]; ++j)
                    for (int k = 0; k < end[2]; ++k) {
                        const float* here = field.at(i, j, k);
                        float step = 0;
                        for (int d = 0; d < 3; ++d) step += (here[next + d] - here[d]) * (here[next + d] - here[d]);
                        longest = std::max(longest, step);
                    }
            squares += longest * per_cm;
        }
        return float(std::sqrt(squares)) * kRounding;
    }

    void add(const Displacement& one, int pose) {
        Field field{};
        std::copy_n(one.size, 3, field.size);
        const double* row = one.to_grid + (one.has_many_places ? 12 * pose : 0);
        for (int a = 0; a < 3; ++a, row += 4) {
            field.to_grid[a][3] = row[3];
            for (int d = 0; d < 3; ++d)
                field.to_grid[a][d] = row[d] * kMmPerCm, field.to_grid[a][3] += row[d] * one.centre_mm[d];
        }
        const int64_t floats = one.floats();
        std::vector<float> packed(floats / 3 * 4);
        const float* from = one.coefficients + (one.has_many ? floats * pose : 0);
        for (int64_t i = 0; i < floats; ++i) packed[i / 3 * 4 + i % 3] = from[i] / kMmPerCm;
        field.coefficients = packed.data();
        packed_.push_back(std::move(packed));
        fields_.push_back(field);
    }

    int each_;  // of a pose
    std::vector<std::vector<float>> packed_;
    std::vector<Field> fields_;               // [poses, each]
    std::vector<std::vector<Layer>> layers_;  // likewise
};

// One allocation of the four accumulators of a strip, row by row: a plane each would put the four of a pixel at addresses
// that differ by a multiple of 4 KB, where a processor takes the loads of one for those that its stores to another feed.
class StripBuffer {
 public:
    StripBuffer(int height, int lines) : width_(lines + kMaxLanes), rows_(height) {
        floats_ = static_cast<float*>(::operator new(int64_t(4) * width_ * rows_ * sizeof(float), std::align_val_t(64)));
    }
    ~StripBuffer() { ::operator delete(floats_, std::align_val_t(64)); }
    StripBuffer(const StripBuffer&) = delete;
    StripBuffer& operator=(const StripBuffer&) = delete;

    Strip clear(int first, int lines) {
        float* at = floats_;
        for (int row = 0; row < rows_; ++row, at += 4 * width_) {
            std::fill_n(at, 2 * width_, 0.0f);
            std::fill_n(at + 2 * width_, 2 * width_, 1.0f);
        }
        return {floats_, floats_ + width_, floats_ + 2 * width_, floats_ + 3 * width_, 4 * width_, first, lines};
    }

 private:
    int width_, rows_;
    float* floats_;
};

// Gradients by the coefficients of fields, of each part of the Gaussians and each pose.
class FieldGradients {
 public:
    FieldGradients(const Displacements& displacements, const std::vector<float*>& out, int parts, int poses)
        : displacements_(displacements), out_(out), poses_(poses) {
        for (int place = 0; !out.empty() && place < parts * poses; ++place)
            for (const Displacement& one : displacements) {
                gradients_.emplace_back(one.floats() / 3 * 4);
                pointers_.push_back(gradients_.back().data());
            }
    }

    float* const* of(int part, int pose) const {
        return out_.empty() ? nullptr : pointers_.data() + (int64_t(part) * poses_ + pose) * int64_t(out_.size());
    }

    void add_up() const {
        for (size_t place = 0; place < gradients_.size(); ++place) {
            const Displacement& one = displacements_[place % out_.size()];
            const int64_t pose = int64_t(place / out_.size()) % poses_;
            float* to = out_[place % out_.size()] + (one.has_many ? pose * one.floats() : 0);
            for (int64_t i = 0; i < one.floats(); ++i) to[i] += gradients_[place][i / 3 * 4 + i % 3] / kMmPerCm;
        }
    }

 private:
    const Displacements& displacements_;
    const std::vector<float*>& out_;
    int poses_;
    std::vector<std::vector<float>> gradients_;  // [parts, poses, displacements]
    std::vector<float*> pointers_;
};

// Some poses on their way from Gaussians to pixels.
class Batch {
 public:
    // Of `count` poses from the `first` of all.
    Batch(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int first, int count, int height,
          int width, const Kernels& kernels, const Displacements& displacements = {})
        : kernels_(kernels), scene_(scene.view()), lines_(probe, width), fields_(displacements, first, count) {
        for (int c = 0; c < count; ++c) {
            views_.push_back(make_view(probe, lines_, poses + 16 * (first + c), height, width, !scene_.weighted));
            fields_.apply(views_.back(), c);
        }
        slices_ = std::vector<SliceList>(int64_t(count) * parts());
    }
    Batch(const Batch&) = delete;
    Batch& operator=(const Batch&) = delete;

    // `first` is the number of the first pose, for errors. Throws GivenUp, TooCostly.
    void render(const Outputs& outputs, const std::vector<SavedPlanes>& saved, int threads, const Limits& limits = {},
                int first = 0, const Lines& drawn = {}) {
        const int first_strip = drawn.first / kStripLines, end = std::min(drawn.end, views_[0].lines);
        const int strips = (end + kStripLines - 1) / kStripLines - first_strip;
        const auto check = [&](int c) {
            const auto& most = limits.footprint_pixels;
            if (sum(c, footprint_bound) <= most) return;
            const int64_t pixels = sum(c, footprint_pixels);
            if (pixels > most) throw TooCostly(first + c, pixels);
        };
        const auto draw_strip = [&](int task) {
            const int c = task / strips, line = (first_strip + task % strips) * kStripLines;
            draw(c, line, outputs, saved.empty() ? SavedPlanes{} : saved[c], limits);
        };
        if (saved.empty() && count() >= kPosesOfAThread * threads) {
            // Slices are drawn by the thread that made them, out of its cache.
            Phase whole{count(), [&](int c) {
                            for (int part = 0; part < parts(); ++part) slice(c * parts() + part, limits);
                            check(c);
                            for (int strip = 0; strip < strips; ++strip) draw_strip(c * strips + strip);
                            for (int part = 0; part < parts(); ++part) slices_[int64_t(c) * parts() + part].clear();
                        }};
            run_phases({&whole}, threads);
            return;
        }
        Phase slicing{count() * parts(), [&](int task) { slice(task, limits); }};
        Phase checking{count(), check};
        Phase drawing{count() * strips, draw_strip};
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
    // parts in order, and so do the beam and the fields, whose gradients have the shape of their coefficients.
    BeamMoments differentiate(const std::vector<SavedPlanes>& saved, const Outputs& gradients,
                              const std::vector<PixelGradients>& pixels, GaussianGradient* gaussians, float* sh,
                              ViewGradient* views, const Displacements& displacements,
                              const std::vector<float*>& by_displacements, int threads) const {
        const FieldGradients by_fields(displacements, by_displacements, parts(), count());
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
                                                  moments[part], views ? &by_part[place] : nullptr, by_fields.of(part, c));
                              }
                          }};
        run_phases({&by_pixel, &by_gaussian}, threads);
        by_fields.add_up();
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
    Fields fields_;
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

SliceList::~SliceList() { clear(); }

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

void SliceList::clear() {
    std::free(data_);
    data_ = nullptr;
    size_ = capacity_ = lines = 0;
}

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
            const Lines& drawn, const Displacements& displacements) {
    const Kernels& kernels = choose_kernels(instruction_set);
    const int64_t frame_size = int64_t(height) * width;
    const int at_once = count >= kPosesOfAThread * threads ? kPosesShared : kPosesAtOnce;
    for (int first = 0; first < count; first += at_once) {
        Batch batch(scene, probe, poses, first, std::min(at_once, count - first), height, width, kernels, displacements);
        batch.render(outputs.from(first, frame_size), {}, threads, limits, first, drawn);
    }
}

void footprints(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count, int height,
                int width, int threads, const std::string& instruction_set, const Limits& limits, int64_t* pixels,
                const Displacements& displacements) {
    const Kernels& kernels = choose_kernels(instruction_set);
    for (int first = 0; first < count; first += kPosesAtOnce) {
        Batch batch(scene, probe, poses, first, std::min(kPosesAtOnce, count - first), height, width, kernels,
                    displacements);
        batch.footprints(pixels + first, threads, limits);
    }
}

std::vector<Work> drawing_work(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count,
                               int height, int width, int threads, const std::string& instruction_set) {
    if (count == 0) throw std::invalid_argument("there must be at least one pose");
    Batch batch(scene, probe, poses, 0, count, height, width, choose_kernels(instruction_set));
    return batch.work(threads);
}

struct Recording::State {
    Batch batch;
    Planes planes;
    std::vector<SavedPlanes> saved;
    int stride;
};

Recording::Recording(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count, int height,
                     int width, int threads, const std::string& instruction_set, const Outputs& outputs,
                     const Displacements& displacements)
    : scene_(scene), count_(count), height_(height), width_(width), displacements_(displacements) {
    if (scene.order() == Order::Sorted) throw std::invalid_argument("a recording needs a scene in its given order");
    if (count == 0) return;
    const int stride = (width + kMaxLanes - 1) / kMaxLanes * kMaxLanes + kMaxLanes;
    state_.reset(new State{{scene, probe, poses, 0, count, height, width, choose_kernels(instruction_set), displacements},
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
                                     const std::vector<float*>& by_displacements, int threads) const {
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
        moments = state_->batch.differentiate(state_->saved, gradients, pixels, gaussians.data(), sh.data(), views,
                                              displacements_, by_displacements, threads);
    }
    scene_.to_raw(gaussians.data(), sh.data(), out, threads);
    return moments;
}

}  // namespace ultragray
