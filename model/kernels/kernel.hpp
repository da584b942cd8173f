// The CPU renderer's data and the seam between what is compiled once and what is compiled per instruction set.
// Lengths are centimetres. C poses, N Gaussians, H depth samples, W scan lines (docs/physics.md §1-§5).
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>

#include "views.hpp"

namespace ultragray {

inline constexpr double kMaxM2 = 11.0825270903;  // -2 log(1/255): w < 1/255 beyond, and alpha too
inline constexpr int kMaxShCoefficients = 16;
inline constexpr int kClusterSize = 32;
inline constexpr int kMaxLanes = 16;  // of the widest instruction set; buffers are padded by this many columns

enum class Intensity : int32_t { Released = 0, Sigmoid = 1 };

// One Gaussian, activated.
struct Gaussian {
    float mean[3];   // cm
    float scale[3];  // cm
    float quat[4];   // unit, wxyz
    float absorb;    // 1 - tau; of a weighted scene 1 - the Gaussian's weight
    float reach;     // distance beyond which the Gaussian has w and alpha under 1/255, cm
};

// kClusterSize consecutive Gaussians: a box around their means and the largest reach among them.
struct Cluster {
    float centre[3];
    float half[3];
    float reach;
};

struct SceneView {
    const Gaussian* gaussians;  // [N]
    const float* sh;            // [N, K]
    const Cluster* clusters;    // [ceil(N / kClusterSize)]
    int64_t count;
    int64_t cluster_count;
    int sh_degree;
    Intensity intensity;
    bool weighted;  // w of a Gaussian is multiplied by its weight, and it absorbs nothing
};

// The variance of the slice along elevation by depth s: at_focus + slope2 (s - focus)^2, and the most of it that is seen.
struct Beam {
    double at_focus, focus, slope2, most;  // cm2, cm, 1, cm2
    bool is_thick() const { return at_focus > 0; }
};

inline constexpr int kMaxFields = 4;  // one after another

// Bounds of a field along elevation, for coordinates of the grid's third axis from one whole number to the next.
struct Layer {
    float least, most;        // displacement, cm
    float gradient, stretch;  // the norms of its gradient, and of FT n, by which Gaussians reach farther
    void widen(const Layer& other) {
        least = other.least < least ? other.least : least, most = other.most > most ? other.most : most;
        gradient = other.gradient > gradient ? other.gradient : gradient;
        stretch = other.stretch > stretch ? other.stretch : stretch;
    }
};

// A smooth displacement of tissue: at grid coordinates g = to_grid (x, 1) the sum of coefficients times the cubic B-splines
// around their places; beyond the outermost cells (1 to size - 2) as at the border.
struct Field {
    const float* coefficients;  // [X, Y, Z, 4] cm along the scene's axes, and 0
    double to_grid[3][4];
    int size[3];          // each at least 4
    const Layer* layers;  // [Z - 3]
    float steepest;       // 1 + bound of the norm of its gradient; of the last field of a view, 1
    int64_t place(int i, int j, int k) const { return 4 * ((int64_t(i) * size[1] + j) * size[2] + k); }
    const float* at(int i, int j, int k) const { return coefficients + place(i, j, k); }
};

// The gradient with respect to a beam's variance, summed over slices, times powers of s - focus.
struct BeamMoments {
    double zeroth, first, second;
};

// One pose and the probe's scan lines.
struct View {
    double axes[3][3];  // rows: the probe's lateral, elevation and axial axes in the scene's frame
    double origin[3];
    const double* line_x;  // [W + kMaxLanes] lateral origin of each scan line
    const double* dir_x;   // [W + kMaxLanes] direction of each scan line in the image plane
    const double* dir_z;
    float spacing[kMaxLanes];    // of parallel lines: line_x of a line and of those after it, from the former
    double near, row_step;       // row i lies at near + row_step * (i + 1/2)
    double cull_near, cull_far;  // Gaussians whose means lie outside do not count
    double start, span;          // line j of W is at start + span * (j + 1/2) / W: cm along x, or radians from z
    bool wrap;                   // fanned all the way round: the first line follows the last
    bool absorbs;                // whether Gaussians do
    bool fanned;                 // the lines run from an apex at the origin, else side by side along z
    int height, lines;
    Beam beam;
    const Field* fields;  // by which Gaussians are displaced, one after another
    int field_count;
    Layer displaced;  // bounds of all of them
};

// A Gaussian cut by the image plane: a 2D Gaussian there, and what it adds.
struct Slice {
    double mean_x, mean_z;
    double cov_xx, cov_xz, cov_zz;
    double depth;         // of the mean along its scan line
    float m2_plane;       // squared Mahalanobis distance of the plane from the mean; -2 log(weight) is added
    float intensity;      // I
    float absorb;         // 1 - tau
    int32_t first, last;  // scan lines it may touch
    int32_t gaussian;     // its place in the scene
};

// A growable array of slices that code compiled for any instruction set may append to.
class SliceList {
 public:
    SliceList() = default;
    SliceList(const SliceList&) = delete;
    SliceList& operator=(const SliceList&) = delete;
    ~SliceList();
    Slice* append(int n);  // room for n more; call shrink_by for those not written
    void shrink_by(int n);
    void clear();  // gives its memory back
    const Slice* data() const { return data_; }
    int64_t size() const { return size_; }
    int64_t lines = 0;  // scan lines that each slice may touch, added up

 private:
    Slice* data_ = nullptr;
    int64_t size_ = 0, capacity_ = 0;
};

// The outputs of poses, one after another; null where one was not asked for.
struct Outputs {
    float *bmode, *echo, *transmittance, *coverage, *weight_sum, *intensity_sum;  // [H, W]; the last are S and sum of I*w
    uint8_t* grey;       // [H, W]: 255 min(B, 1) to the nearest whole number, of two the even one
    int64_t* supported;  // the number of pixels with a coverage of at least the one below; added to
    float least_coverage;

    // Those from a pose on.
    Outputs from(int64_t pose, int64_t frame_size) const {
        const auto at = [&](auto* plane) { return plane ? plane + pose * frame_size : nullptr; };
        return {at(bmode),      at(echo),          at(transmittance), at(coverage),
                at(weight_sum), at(intensity_sum), at(grey),          supported ? supported + pose : nullptr,
                least_coverage};
    }
};

// What the backward pass needs of one pose, rows of `stride` floats; null where no gradient is wanted.
struct SavedPlanes {
    float *weight, *intensity, *transmittance;  // S, sum of I*w, T
    int stride;
};

// The gradient of the loss with respect to S, the sum of I*w and log T of each pixel, and with respect to a factor of T on
// all pixels of a scan line from this row down (the suffix sum of the former). Rows of `stride` floats, zero beyond the last
// line.
struct PixelGradients {
    float *weight, *intensity, *log_transmittance, *below;
    int stride;
};

// The gradient with respect to one activated Gaussian.
struct GaussianGradient {
    float mean[3];
    float log_scale[3];
    float quat[4];
    float absorb;  // of a weighted scene, by the log of the weight
};

// The gradient with respect to a rigid motion of the view, in the scene's axes: a shift in cm, and a turn in radians about
// the view's origin.
struct ViewGradient {
    double shift[3], turn[3];
};

// Accumulators of a strip of scan lines, rows of `stride` floats.
struct Strip {
    float *weight, *intensity, *local, *below;  // S, sum of I*w, T inside footprints, T steps at the rows below them
    int stride;
    int first, lines;
};

// What drawing takes, counted. A group is a vector of scan lines across a slice.
struct Work {
    int64_t slices, groups;
    int64_t rows;   // of all groups
    int64_t lanes;  // of all rows: those whose scan line its slice touches
};

// Sums over an image of |x - y|, and over its windows of SSIM.
struct ImageLoss {
    double l1, ssim;
};

// The numbers of one step of Adam.
struct AdamStep {
    float beta1, beta2;
    float rate;     // over 1 - beta1^t
    float by_root;  // 1 / sqrt(1 - beta2^t)
    float eps;
};

// Floats that image_loss needs as scratch, and the length of its rows.
inline int loss_stride(int width) { return (width + 10 + kMaxLanes - 1) / kMaxLanes * kMaxLanes + kMaxLanes; }
inline int64_t loss_scratch(int height, int width) {
    return (int64_t(height) + 10 + 1) * 5 * loss_stride(width) + kMaxLanes;
}

inline constexpr int kSpeckleLevels = 9;  // grey levels of which the strength is known, from 0 to 1
inline constexpr int kSpeckleTaps = 64;   // the most weights along a column, and along a row

// What the speckle of frames of one size has in common. Samples lie at every `row_step`-th row and `column_step`-th scan
// line, and on either side of the image: row i is the sum of samples i / row_step … of `row_taps` weights, scan lines
// likewise.
struct SpeckleGrid {
    // `columns` is a multiple of kMaxLanes.
    int height, width, rows, columns, row_step, column_step, row_taps, column_taps;
    const float* row_weights;     // [H, row_taps]
    const float* column_weights;  // [H, column_step, column_taps]
    const float* plane_weights;   // [rows, 2]: the plane in the middle of the slice, and those beside it
    const float* strength;        // [kSpeckleLevels]
    uint32_t seed;
    float first_look;          // share of the power
    float floor, mean, scale;  // speckle is (log2(power + floor) - mean) * scale
};

// One pose: places of samples in cells of tissue, with 16 bits after the point.
struct SpeckleView {
    const int32_t* starts;           // [3, columns] of the first row
    const int32_t* steps;            // [3, columns] from row to row
    uint32_t beside[3];              // from plane to plane
    float plane_cosine, plane_sine;  // phase from plane to plane
    const float* column_phases;      // [2, columns] cosine and sine
};

// Floats that speckle needs as scratch, and the length of its rows.
inline int speckle_stride(const SpeckleGrid& grid) { return grid.columns + kMaxLanes; }
inline int64_t speckle_scratch(const SpeckleGrid& grid) {
    return (int64_t(grid.row_taps) * 4 + 4 + 2 * grid.column_step) * speckle_stride(grid) + kMaxLanes;
}

// What each instruction set provides.
struct Kernels {
    const char* name;
    void (*slice)(const SceneView&, const View&, int64_t first_cluster, int64_t last_cluster, SliceList&);
    void (*draw)(const View&, const Slice*, int64_t count, const Strip&);
    void (*count)(const View&, const Slice*, int64_t count, int first, int lines, Work&);  // of drawing a strip; added to
    void (*finish)(const View&, const Strip&, const Outputs&, const SavedPlanes&);
    // The backward pass: pixels of `lines` scan lines from `first` on, then slices; [N], sh [N, K], the beam's moments and,
    // where they are not null, the gradients by the view and by the coefficients of its fields are added to.
    void (*differentiate)(const View&, int first, int lines, const SavedPlanes&, const Outputs& gradients,
                          const PixelGradients&);
    void (*gather)(const SceneView&, const View&, const Slice*, int64_t count, const PixelGradients&, GaussianGradient*,
                   float* sh, BeamMoments&, ViewGradient*, float* const* by_fields);
    // Writes `by_l1` times the gradient of sum |x - y| plus `by_ssim` times that of the sum of SSIM; `window` sums to 1.
    // With a weight (not null) x is y + weight (x - y).
    ImageLoss (*image_loss)(const float* x, const float* y, const float* weight, int height, int width, const float* window,
                            float* scratch, float by_l1, float by_ssim, float* gradient);
    void (*speckle)(const SpeckleGrid&, const SpeckleView&, int first, int last, const float* bmode, float* scratch,
                    float* out);
    double (*adam)(float* values, const float* gradient, float* first, float* second, int64_t count, const AdamStep&,
                   float by_sum);
    void (*measure_views)(const float* points, int count, const float* angles, const float* facing, const ViewImages&,
                          const ViewLimits&, const ViewDistances&);
};

// The kernels of an instruction set that this processor can run; "auto" takes the best. Throws std::invalid_argument.
const Kernels& choose_kernels(const std::string& name);

const Kernels& kernels_baseline();
#if defined(ULTRAGRAY_X86)
const Kernels& kernels_avx2();
const Kernels& kernels_avx512();
#endif

}  // namespace ultragray
