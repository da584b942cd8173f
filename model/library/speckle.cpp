#include "speckle.hpp"

#include <algorithm>

#include "../kernels/speckle.hpp"

namespace ultragray::library {
namespace {

constexpr double kTurnRad = 0.47, kShear[2] = {0.618, 0.324}, kReach = 2.4, kLeastSigmaPixels = 0.3,
                 kMostSigmaSamples = 12.0;
constexpr double kMostPlaneVariance = 0.6, kLeastColumnMm = 1e-6, kMostStep = 4096;
const double kByteDeviation = std::sqrt((256.0 * 256.0 - 1.0) / 12.0);

// A width that the model has in the middles of bands of depth.
double by_depth(const std::vector<double>& widths, const Probing& probe, double depth) {
    const double bands = double(widths.size());
    const auto middle = [&](size_t band) { return probe.near_mm + (double(band) + 0.5) / bands * probe.length_mm(); };
    if (depth <= middle(0)) return widths.front();
    for (size_t band = 0; band + 1 < widths.size(); ++band)
        if (depth < middle(band + 1))
            return (widths[band + 1] - widths[band]) / (middle(band + 1) - middle(band)) * (depth - middle(band)) +
                   widths[band];
    return widths.back();
}

// A cell is a box, whose own variance is a part of the point-spread function's.
double sigma_samples(double sigma_mm, double cell_mm, double pixel_mm, int step) {
    const double own = std::sqrt(std::max(sigma_mm * sigma_mm - cell_mm * cell_mm / 12.0, 0.0));
    return std::min(std::max(own / pixel_mm, kLeastSigmaPixels) / step, kMostSigmaSamples);
}

double gaussian(double offset, double sigma) {
    if (std::fabs(offset) > kReach * sigma + 0.5) return 0.0;
    return std::exp(-0.5 * ((offset / sigma) * (offset / sigma)));
}

std::vector<double> autocorrelation(const std::vector<double>& weights) {
    const int count = int(weights.size());
    std::vector<double> found;
    for (int lag = 1 - count; lag < count; ++lag) {
        double sum = 0;
        for (int k = std::max(0, -lag); k < std::min(count, count - lag); ++k) sum += weights[k] * weights[k + lag];
        found.push_back(sum);
    }
    return found;
}

// The probability that two points so many cells apart along an axis lie in the same one.
double shared(double cells) { return std::max(1.0 - std::fabs(cells), 0.0); }

// Mean square of a row's weighted sums of samples of variance 1: samples in the same cell are the same.
double power_of(const std::vector<double>& down, const std::vector<double>& across, double side, double step_down,
                double step_across) {
    const std::vector<double> rows = autocorrelation(down), columns = autocorrelation(across);
    const double cosine = std::cos(kTurnRad), sine = std::sin(kTurnRad);
    double power = 0;
    for (size_t r = 0; r < rows.size(); ++r)
        for (size_t c = 0; c < columns.size(); ++c) {
            const double z = (double(r) - double(rows.size() / 2)) * step_down;
            const double x = (double(c) - double(columns.size() / 2)) * step_across;
            const double i = cosine * x - sine * z, k = sine * x + cosine * z, j = kShear[0] * x + kShear[1] * z;
            const double planes = (1.0 + 2.0 * side * side) * shared(j) + 2.0 * side * (shared(j + 1.0) + shared(j - 1.0)) +
                                  side * side * (shared(j + 2.0) + shared(j - 2.0));
            power += rows[r] * columns[c] * (shared(i) * shared(k) * planes);
        }
    return power;
}

int32_t fixed(double cells) {
    return int32_t(uint32_t(int64_t(std::floor(cells * 65536.0 + 0.5))));  // 16 bits after the point, modulo 65536 cells
}

// A hash of 32 bits (lowbias32 of C. Wellons): seeds beside each other would else be the same speckle, shifted by a cell.
uint32_t scattered(uint32_t x) {
    x = (x ^ x >> 16) * 0x7feb352du;
    x = (x ^ x >> 15) * 0x846ca68bu;
    return x ^ x >> 16;
}

}  // namespace

SpeckleSamples::SpeckleSamples(const SpeckleModel& model, const Probing& probe, int height, int width)
    : probe(probe), height(height), width(width) {
    const double row_mm = probe.length_mm() / height;
    std::vector<double> axial, lateral, column_mm;
    double fewest_rows = HUGE_VAL, fewest_columns = HUGE_VAL;  // a standard deviation
    for (int row = 0; row < height; ++row) {
        const double depth = probe.depth_mm(row, height);
        axial.push_back(by_depth(model.axial_mm, probe, depth));
        lateral.push_back(by_depth(model.lateral_mm, probe, depth));
        column_mm.push_back(std::max(probe.breadth_mm(depth) / width, kLeastColumnMm));
        fewest_rows = std::min(fewest_rows, axial[row] / row_mm);
        fewest_columns = std::min(fewest_columns, lateral[row] / column_mm[row]);
    }
    row_step = int(std::clamp(fewest_rows, 1.0, kMostStep)), column_step = int(std::clamp(fewest_columns, 1.0, kMostStep));
    std::vector<double> down, across;
    double most_down = 0, most_across = 0;
    for (int row = 0; row < height; ++row) {
        down.push_back(sigma_samples(axial[row], model.cell_mm[2], row_mm, row_step));
        across.push_back(sigma_samples(lateral[row], model.cell_mm[0], column_mm[row], column_step));
        most_down = std::max(most_down, down[row]), most_across = std::max(most_across, across[row]);
    }
    const int above = int(std::ceil(kReach * most_down)), beside = int(std::ceil(kReach * most_across));
    row_taps = 2 * above + 1, column_taps = 2 * beside + 1;
    rows = (height - 1) / row_step + row_taps, columns = (width - 1) / column_step + column_taps;
    columns = (columns + kMaxLanes - 1) / kMaxLanes * kMaxLanes;
    first_row = -above * row_step, first_column = -beside * column_step;
    std::vector<double> sides;
    for (int row = 0; row < rows; ++row) {
        const double depth = probe.near_mm + row_mm * (first_row + row * row_step + 0.5);
        const double cells = by_depth(model.elevation_mm, probe, depth) / model.cell_mm[1];
        const double variance = std::clamp(cells * cells - 1.0 / 12.0, 0.0, kMostPlaneVariance);
        sides.push_back(variance / (2.0 - 2.0 * variance));  // (side, 1, side) has this variance
        plane_weights.push_back(1.0f), plane_weights.push_back(float(sides[row]));
    }
    std::vector<double> taps(row_taps), mean(column_taps);
    for (int row = 0; row < height; ++row) {
        const double phase = double(row % row_step) / row_step;
        for (int t = 0; t < row_taps; ++t) taps[t] = gaussian(t - above - phase, down[row]);
        std::fill(mean.begin(), mean.end(), 0.0);
        for (int p = 0; p < column_step; ++p)
            for (int t = 0; t < column_taps; ++t) {
                const double weight = gaussian(t - beside - double(p) / column_step, across[row]);
                column_weights.push_back(float(weight));
                mean[t] += weight;
            }
        for (double& one : mean) one /= column_step;
        const double power = power_of(taps, mean, sides[above + row / row_step], row_step * row_mm / model.cell_mm[2],
                                      column_step * column_mm[row] / model.cell_mm[0]);
        for (const double one : taps) row_weights.push_back(float(one / (std::sqrt(2.0 * power) * kByteDeviation)));
    }
}

// The moments of the logarithm to base 2 of a power of mean 1: that of two exponential variables of means a and 1 - a, where
// looks = 1 / (a² + (1 - a)²).
SpeckleOfScene::SpeckleOfScene(const SpeckleModel& model, const std::vector<Pose>& poses) : model_(model) {
    const Matrix axes = mean_axes(poses);
    const double cosine = std::cos(kTurnRad), sine = std::sin(kTurnRad);
    Matrix turned{{{cosine, 0.0, -sine}, {kShear[0], 1.0, kShear[1]}, {sine, 0.0, cosine}}};
    for (Vector& row : turned)
        for (int k = 0; k < 3; ++k) row[k] /= model.cell_mm[k];
    to_cells_ = times(turned, transposed(axes));
    axial_ = transposed(axes)[2];
    constexpr int kPowers = 8001;
    first_look_ = 0.5 * (1.0 + std::sqrt(std::max(2.0 / model.looks - 1.0, 0.0)));
    const double second = 1.0 - first_look_;
    std::vector<double> weights, levels;
    double sum = 0, variance = 0;
    for (int k = 0; k < kPowers; ++k) {
        const double power = std::exp(k == kPowers - 1 ? 4.0 : k * (20.0 / (kPowers - 1)) - 16.0);
        const double density = second < 1e-6 ? std::exp(-power)
                               : first_look_ - second < 1e-3
                                   ? 4.0 * power * std::exp(-2.0 * power)
                                   : (std::exp(-power / first_look_) - std::exp(-power / second)) / (first_look_ - second);
        weights.push_back(density * power);  // d power = power d log power
        levels.push_back(std::log2(power + model.floor));
        sum += weights[k];
    }
    mean_ = 0;
    for (int k = 0; k < kPowers; ++k) mean_ += weights[k] / sum * levels[k];
    for (int k = 0; k < kPowers; ++k) variance += weights[k] / sum * ((levels[k] - mean_) * (levels[k] - mean_));
    deviation_ = std::sqrt(variance);
}

std::vector<float> SpeckleOfScene::added(const std::vector<float>& bmode, const SpeckleSamples& samples, const Pose& pose,
                                         int threads) const {
    const Probing& probe = samples.probe;
    const int columns = samples.columns;
    const double row_mm = probe.length_mm() / samples.height;
    const Matrix to_cells = times(to_cells_, pose.turn);  // from mm in the probe's frame
    const Vector begin = times(to_cells_, pose.origin);
    // A carrier gives echoes a phase where the probe is turned from the mean direction of the sweep.
    const Vector phase_by_mm = times(pose.turned_back(axial_), model_.wavenumber_per_mm);
    const double middle = 0.5 * (probe.near_mm + probe.far_mm), plane_phase = phase_by_mm[1] * model_.cell_mm[1];
    std::vector<int32_t> starts(3 * size_t(columns)), steps(starts.size());
    std::vector<float> phases(2 * size_t(columns));
    for (int k = 0; k < columns; ++k) {
        const int column = samples.first_column + k * samples.column_step;
        const double across = probe.start() + probe.span * (column + 0.5) / samples.width;
        const Ray ray = probe.ray(across);
        const Vector first = times(to_cells, ray.at(probe.near_mm + row_mm * (samples.first_row + 0.5)));
        const Vector step = times(to_cells, times(ray.direction, row_mm * samples.row_step));
        for (int axis = 0; axis < 3; ++axis) {
            starts[axis * columns + k] = fixed(first[axis] + begin[axis]);
            steps[axis * columns + k] = fixed(step[axis]);
        }
        const double phase = phase_by_mm[0] * (probe.is_angular() ? across * (kPi / 180.0) * middle : across);
        phases[k] = float(std::cos(phase)), phases[columns + k] = float(std::sin(phase));
    }
    uint32_t beside[3];
    for (int axis = 0; axis < 3; ++axis) beside[axis] = uint32_t(fixed(model_.cell_mm[1] * to_cells[axis][1]));
    const std::vector<float> strength(model_.strength.begin(), model_.strength.end());
    const SpeckleGrid grid{samples.height,
                           samples.width,
                           samples.rows,
                           columns,
                           samples.row_step,
                           samples.column_step,
                           samples.row_taps,
                           samples.column_taps,
                           samples.row_weights.data(),
                           samples.column_weights.data(),
                           samples.plane_weights.data(),
                           strength.data(),
                           scattered(uint32_t(model_.seed)),
                           float(first_look_),
                           float(model_.floor),
                           float(mean_),
                           float(1.0 / deviation_)};
    const SpeckleView view{starts.data(),
                           steps.data(),
                           {beside[0], beside[1], beside[2]},
                           float(std::cos(plane_phase)),
                           float(std::sin(plane_phase)),
                           phases.data()};
    std::vector<float> shown(bmode.size());
    add_speckle(grid, &view, 1, threads, "auto", bmode.data(), shown.data());
    return shown;
}

}  // namespace ultragray::library
