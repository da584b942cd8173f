#include "tissue.hpp"

#include <algorithm>
#include <cmath>

namespace ultragray::library {
namespace {

constexpr size_t kNeighbours = 8;
constexpr double kSticking = 3.0, kLeastSpacing = 1e-3, kNoTurn = 1e-300;
constexpr int kPolarSteps = 3, kWithinThePlane[3] = {0, 2, 4};

// Axis times angle, at most pi, of a rotation: by the largest component of its quaternion.
Vector turn_of(const Matrix& r) {
    double products[4][4];
    quaternion_products(r, products);
    int largest = 0;
    for (int k = 1; k < 4; ++k)
        if (products[k][k] > products[largest][largest]) largest = k;
    const double* q = products[largest];
    double norm = 0;
    for (int k = 0; k < 4; ++k) norm += q[k] * q[k];
    norm = std::copysign(std::sqrt(norm), q[0]);
    const double sine = std::sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3]) / std::fabs(norm);
    const double angle = 2.0 * std::atan2(sine, q[0] / norm), scale = sine == 0.0 ? 0.0 : angle / sine / norm;
    return {q[1] * scale, q[2] * scale, q[3] * scale};
}

// Rodrigues' formula.
Matrix rotation_of(const Vector& turn) {
    const double angle = length(turn);
    const auto [x, y, z] = times(turn, 1.0 / std::max(angle, kNoTurn));
    const Matrix cross{{{0, -z, y}, {z, 0, -x}, {-y, x, 0}}}, square = times(cross, cross);
    const double sine = std::sin(angle), versine = 1.0 - std::cos(angle);
    Matrix rotation;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) rotation[i][j] = (i == j) + sine * cross[i][j] + versine * square[i][j];
    return rotation;
}

Vector mean_corner(const Probing& probe) {
    Vector mean{};
    const auto corners = probe.corners();
    for (const Vector& corner : corners)
        for (int d = 0; d < 3; ++d) mean[d] += corner[d] / double(corners.size());
    return mean;
}

double squares_between(const std::vector<double>& one, const std::vector<double>& other) {
    double sum = 0;
    for (size_t k = 0; k < one.size(); ++k) sum += (one[k] - other[k]) * (one[k] - other[k]);
    return sum;
}

// errors⁻¹ · pose, of rigid motions.
Pose undone(const Pose& error, const Pose& pose) {
    return {times(transposed(error.turn), pose.turn), error.turned_back(minus(pose.origin, error.origin))};
}

}  // namespace

FollowingTissue::Path::Path(const std::vector<Pose>& poses, const Probing& probe) : poses_(poses), own_(probe.corners()) {
    for (const Pose& pose : poses) corners_.push_back(corners_from(pose));
    std::vector<double> steps;
    for (size_t p = 1; p < corners_.size(); ++p)
        steps.push_back(std::sqrt(squares_between(corners_[p], corners_[p - 1]) / double(own_.size())));
    double median = 0.0;
    if (!steps.empty()) {
        std::sort(steps.begin(), steps.end());
        median = 0.5 * (steps[(steps.size() - 1) / 2] + steps[steps.size() / 2]);
    }
    spacing_mm_ = std::max(median, kLeastSpacing);
}

std::vector<double> FollowingTissue::Path::corners_from(const Pose& pose) const {
    std::vector<double> found;
    for (const Vector& corner : own_)
        for (const double one : pose.at(corner)) found.push_back(one);
    return found;
}

std::vector<std::pair<size_t, double>> FollowingTissue::Path::nearest(const Pose& pose) const {
    const std::vector<double> asked = corners_from(pose);
    std::vector<std::pair<double, size_t>> squares;
    for (size_t p = 0; p < corners_.size(); ++p)
        squares.emplace_back(squares_between(asked, corners_[p]) / double(own_.size()), p);
    const size_t count = std::min(kNeighbours, squares.size());
    std::partial_sort(squares.begin(), squares.begin() + count, squares.end());
    std::vector<std::pair<size_t, double>> found;
    double total = 0;
    for (size_t k = 0; k < count; ++k) {
        const double weight = std::exp(-0.5 * (squares[k].first - squares[0].first) / (spacing_mm_ * spacing_mm_));
        found.emplace_back(squares[k].second, weight);
        total += weight;
    }
    for (auto& [frame, weight] : found) weight /= total;
    return found;
}

Pose FollowingTissue::Path::at(const std::vector<std::pair<size_t, double>>& place) const {
    Pose mean{};
    for (const auto& [frame, weight] : place) {
        mean.origin = plus(mean.origin, times(poses_[frame].origin, weight));
        for (int i = 0; i < 3; ++i) mean.turn[i] = plus(mean.turn[i], times(poses_[frame].turn[i], weight));
    }
    for (int step = 0; step < kPolarSteps; ++step) {
        const Matrix cube = times(times(mean.turn, transposed(mean.turn)), mean.turn);
        for (int i = 0; i < 3; ++i) mean.turn[i] = minus(times(mean.turn[i], 1.5), times(cube[i], 0.5));
    }
    return mean;
}

FollowingTissue::FollowingTissue(const Scene& scene)
    : shares_(*scene.info.tissue_shares),
      middle_(mean_corner(Probing::of(*scene.info.probe))),
      tracked_(scene.training_poses, Probing::of(*scene.info.probe)),
      at_rest_(scene.rest_poses, Probing::of(*scene.info.probe)) {
    for (size_t p = 0; p < scene.errors.size(); ++p) {
        const Pose told = undone(scene.errors[p], scene.training_poses[p]);
        const Way off = way(tracked_.at(tracked_.nearest(told)), told);
        for (int k = 0; k < 3; ++k) sticking_[k] += std::pow(off[kWithinThePlane[k]], 2) / double(scene.errors.size());
    }
    for (double& one : sticking_) one = kSticking * std::sqrt(one);
}

FollowingTissue::Way FollowingTissue::way(const Pose& before, const Pose& after) const {
    const Vector shift = before.turned_back(minus(after.at(middle_), before.at(middle_)));
    const Vector turn = turn_of(times(transposed(before.turn), after.turn));
    return {shift[0], shift[1], shift[2], turn[0], turn[1], turn[2]};
}

Pose FollowingTissue::moved(const Pose& pose, const Way& way) const {
    const Matrix turn = times(pose.turn, rotation_of({way[3], way[4], way[5]}));
    return {turn, minus(pose.at(plus(middle_, {way[0], way[1], way[2]})), times(turn, middle_))};
}

Pose FollowingTissue::at_rest(const Pose& pose) const {
    const auto place = tracked_.nearest(pose);
    Way off = way(tracked_.at(place), pose);
    for (int k = 0; k < 3; ++k) {
        double& one = off[kWithinThePlane[k]];
        one -= (1.0 - shares_[k]) * std::clamp(one, -sticking_[k], sticking_[k]);
    }
    return moved(at_rest_.at(place), off);
}

}  // namespace ultragray::library
