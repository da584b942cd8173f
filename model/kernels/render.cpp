#include "render.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdlib>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <new>
#include <stdexcept>
#include <system_error>
#include <thread>

namespace ultragray {
namespace {

constexpr int kStripLines = 64;  // four accumulators of 512 rows stay within a 1 MB cache
constexpr int64_t kClustersPerTask = 512;
constexpr int kPosesAtOnce = 8;  // bounds the memory that slices take

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

const Kernels& choose_kernels(const std::string& name) {
    static const std::vector<const Kernels*> available = available_kernels();
    for (const Kernels* kernels : available)
        if (name == "auto" || name == kernels->name) return *kernels;
    throw std::invalid_argument("this processor cannot run the instruction set " + name);
}

// Tasks 0 … count − 1, taken by several threads.
struct Phase {
    int count;
    std::function<void(int)> task;
    std::atomic<int> next{0}, done{0};
};

// Runs all tasks of `first`, then all of `second`, on up to `threads` threads, the caller's among them: one start of threads
// for both, because that costs as much as a tenth of a small frame. The first exception is rethrown.
void run_phases(Phase& first, Phase& second, int threads) {
    std::exception_ptr failure;
    std::mutex failure_lock;
    std::atomic<bool> failed{false};
    const auto take_all = [&](Phase& phase) {
        for (int i = phase.next++; i < phase.count; i = phase.next++) {
            try {
                if (!failed) phase.task(i);
            } catch (...) {
                const std::lock_guard<std::mutex> guard(failure_lock);
                if (!failure) failure = std::current_exception();
                failed = true;
            }
            ++phase.done;
        }
    };
    const auto work = [&] {
        take_all(first);
        while (first.done < first.count) std::this_thread::yield();
        take_all(second);
    };
    std::vector<std::thread> helpers;
    const int wanted = std::min(threads, std::max(first.count, second.count)) - 1;
    helpers.reserve(std::max(0, wanted));
    try {
        for (int t = 0; t < wanted; ++t) helpers.emplace_back(work);
    } catch (const std::system_error&) {
        // No more threads to be had: those that run do the work.
    }
    work();
    for (std::thread& helper : helpers) helper.join();
    if (failure) std::rethrow_exception(failure);
}

// Scan lines in the image plane, padded so that a vector may start at any of them.
struct ScanLines {
    std::vector<double> x, dir_x, dir_z;

    ScanLines(const ProbeGeometry& probe, int width) {
        for (int j = 0; j < width + kMaxLanes; ++j) {
            const double across = (std::min(j, width - 1) + 0.5) / width - 0.5;
            x.push_back(probe.convex ? 0.0 : across * probe.width);
            dir_x.push_back(probe.convex ? std::sin(across * probe.opening) : 0.0);
            dir_z.push_back(probe.convex ? std::cos(across * probe.opening) : 1.0);
        }
    }
};

View make_view(const ProbeGeometry& probe, const ScanLines& lines, const double* pose, int height, int width) {
    View view{};
    for (int axis = 0; axis < 3; ++axis) {
        for (int d = 0; d < 3; ++d) view.axes[axis][d] = pose[4 * d + axis];
        view.origin[axis] = pose[4 * axis + 3];
    }
    view.line_x = lines.x.data(), view.dir_x = lines.dir_x.data(), view.dir_z = lines.dir_z.data();
    view.near = probe.near, view.cull_far = probe.cull_far;
    view.row_step = (probe.far - probe.near) / height;
    view.width = probe.width, view.opening = probe.opening, view.convex = probe.convex;
    view.height = height, view.lines = width;
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

FramePointers frame_of(const Outputs& outputs, int64_t offset) {
    const auto at = [offset](float* plane) { return plane ? plane + offset : nullptr; };
    return {at(outputs.bmode), at(outputs.echo), at(outputs.transmittance), at(outputs.coverage)};
}

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

std::vector<std::string> instruction_sets() {
    std::vector<std::string> names;
    for (const Kernels* kernels : available_kernels()) names.push_back(kernels->name);
    return names;
}

void render(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count, int height, int width,
            int threads, const std::string& instruction_set, const Outputs& outputs) {
    const Kernels& kernels = choose_kernels(instruction_set);
    const SceneView gaussians = scene.view();
    const ScanLines lines(probe, width);
    const int parts = static_cast<int>((gaussians.cluster_count + kClustersPerTask - 1) / kClustersPerTask);
    const int strips = (width + kStripLines - 1) / kStripLines;
    const int64_t frame_size = int64_t(height) * width;

    for (int first = 0; first < count; first += kPosesAtOnce) {
        const int views = std::min(kPosesAtOnce, count - first);
        std::vector<View> view;
        for (int c = 0; c < views; ++c) view.push_back(make_view(probe, lines, poses + 16 * (first + c), height, width));

        std::vector<SliceList> slices(int64_t(views) * parts);
        Phase slicing{views * parts, [&](int task) {
                          const int64_t begin = task % parts * kClustersPerTask;
                          const int64_t end = std::min(begin + kClustersPerTask, gaussians.cluster_count);
                          kernels.slice(gaussians, view[task / parts], begin, end, slices[task]);
                      }};
        Phase drawing{views * strips, [&](int task) {
                          thread_local std::unique_ptr<StripBuffer> buffer;
                          thread_local int buffer_height = 0;
                          if (!buffer || buffer_height != height) {
                              buffer.reset();
                              buffer = std::make_unique<StripBuffer>(height, kStripLines);
                              buffer_height = height;
                          }
                          const int c = task / strips, line = task % strips * kStripLines;
                          const Strip strip = buffer->clear(line, std::min(kStripLines, width - line));
                          for (int part = 0; part < parts; ++part) {
                              const SliceList& list = slices[c * parts + part];
                              kernels.draw(view[c], list.data(), list.size(), strip);
                          }
                          kernels.finish(view[c], strip, frame_of(outputs, (first + c) * frame_size));
                      }};
        run_phases(slicing, drawing, threads);
    }
}

}  // namespace ultragray
