#include "assess.hpp"

#include <algorithm>
#include <cmath>

#include "kernel.hpp"

namespace ultragray {
namespace {

constexpr double kDegrees = 180.0 / 3.14159265358979323846;
constexpr float kMmByDegree = 0.02f;
constexpr double kFarMm = 20.0, kSmallestMm = 1e-6, kNeighbourhoodMm = 3.0, kReach = 1.3, kLeastSum = 1e-9;
constexpr double kNearMm = 0.3, kDistanceMm = 5.0, kAngleDeg = 10.0;

double square(double value) { return value * value; }

double logistic(double value) { return 1.0 / (1.0 + std::exp(std::min(-value, 500.0))); }

double between_mm(double a, double b) { return std::min(a * b / std::max(a + b, kLeastSum), kFarMm); }

}  // namespace

TrainingViews::TrainingViews(const double* poses, size_t count, const ImageEdges& edges, const std::string& instruction_set)
    : count_(count), edges_(edges), instruction_set_(instruction_set), filled_(poses, poses + 16 * count) {
    while (filled_.size() / 16 % kMaxLanes) filled_.insert(filled_.end(), poses + 16 * (count - 1), poses + 16 * count);
    const size_t views = filled_.size() / 16;
    for (int axis = 0; axis < 3; ++axis) {
        for (int d = 0; d < 3; ++d)
            for (size_t v = 0; v < views; ++v) axes_.push_back(float(filled_[16 * v + 4 * d + axis]));
        for (size_t v = 0; v < views; ++v) {
            const double* pose = &filled_[16 * v];
            offsets_.push_back(float(pose[axis] * pose[3] + pose[4 + axis] * pose[7] + pose[8 + axis] * pose[11]));
        }
    }
}

TrainingViews::Distances TrainingViews::distances(const float* points, size_t count, const float* angles,
                                                  const float* facing) const {
    const size_t views = filled_.size() / 16;
    Distances found;
    for (std::vector<float>* one : {&found.nearest, &found.before, &found.behind}) one->resize(count);
    found.place.resize(count), found.around.resize(views);
    const ViewImages images{edges_, axes_.data(), offsets_.data(), int64_t(views)};
    const ViewLimits limits{float(kSmallestMm), float(1e3 * kFarMm), kMmByDegree};  // 1e3: of a side without a view
    choose_kernels(instruction_set_)
        .measure_views(
            points, int(count), angles, facing, images, limits,
            {found.nearest.data(), found.before.data(), found.behind.data(), found.place.data(), found.around.data()});
    return found;
}

ViewMeasures TrainingViews::measure(const double* pose, const double* points, size_t count) const {
    const size_t views = filled_.size() / 16;
    std::vector<float> seen, angles, facing;
    for (size_t k = 0; k < count; ++k)
        for (int d = 0; d < 3; ++d) {
            const double *row = pose + 4 * d, *point = points + 3 * k;
            seen.push_back(float(row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3]));
        }
    for (size_t v = 0; v < views; ++v) {
        const double* view = &filled_[16 * v];
        double trace = 0, cosine = 0;
        for (int d = 0; d < 3; ++d) {
            for (int axis = 0; axis < 3; ++axis) trace += pose[4 * d + axis] * view[4 * d + axis];
            cosine += pose[4 * d + 1] * view[4 * d + 1];
        }
        angles.push_back(float(std::acos(std::clamp(0.5 * (trace - 1.0), -1.0, 1.0)) * kDegrees));
        facing.push_back(float(cosine));  // below 0: front and back change places
    }
    const Distances distances = this->distances(seen.data(), count, angles.data(), facing.data());
    ViewMeasures found;
    for (size_t k = 0; k < count; ++k) {
        const double nearest = distances.nearest[k];
        found.nearest_mm.push_back(nearest);
        found.distance_mm.push_back(std::clamp(nearest, kSmallestMm, kFarMm));
        found.interpolation_mm.push_back(between_mm(distances.before[k], distances.behind[k]));
        found.angle_deg.push_back(angles[distances.place[k]]);
    }
    found.around_mm.assign(distances.around.begin(), distances.around.begin() + count_);
    const double least = *std::min_element(found.around_mm.begin(), found.around_mm.end());
    const double reach = std::max(kNeighbourhoodMm, kReach * least);
    double sum = 0;
    for (const double around : found.around_mm) {
        found.weights.push_back(std::exp(square(least / reach) - square(around / reach)));
        sum += found.weights.back();
    }
    for (double& weight : found.weights) weight /= sum;
    return found;
}

void TrainingViews::interpolation_mm(const float* points, size_t count, double* found) const {
    const size_t views = filled_.size() / 16;
    const std::vector<float> upright(views, 0.0f), facing(views, 1.0f);
    const Distances distances = this->distances(points, count, upright.data(), facing.data());
    for (size_t k = 0; k < count; ++k) found[k] = between_mm(distances.before[k], distances.behind[k]);
}

double ConfidenceFormula::predict(const double* distance_mm, const double* interpolation_mm, const double* angle_deg,
                                  size_t count, const double* views) const {
    double hard = 0, sum = 0, within = 0;
    for (size_t v = 0; v < hardness.size(); ++v) hard += views[v] * hardness[v];
    for (size_t k = 0; k < count; ++k) {
        double distance = distance_mm[k];
        if (support) within += std::exp(-square(distance / support->reach_mm));
        if (fitted_to_mm) distance += std::max(distance - *fitted_to_mm, 0.0);
        sum += logistic(weights[0] - weights[1] * std::log1p(interpolation_mm[k] / kNearMm) -
                        weights[2] * (distance / kDistanceMm) - weights[3] * (angle_deg[k] / kAngleDeg) - weights[4] * hard);
    }
    const double expected = black_ms_ssim + (1.0 - black_ms_ssim) * (sum / double(count));
    return support ? limited(expected, support->share * (within / double(count))) : expected;
}

double ConfidenceFormula::limited(double confidence, double supported_share) const {
    if (!support) return confidence;
    return std::min(confidence, black_ms_ssim + (1.0 - black_ms_ssim) * std::min(1.0, support->gain * supported_share));
}

}  // namespace ultragray
