#include "tissue.hpp"

#include <algorithm>
#include <cmath>

namespace ultragray::library {
namespace {

constexpr size_t kNeighbours = 8;
constexpr double kSticking = 3.0, kLeastSpacing = 1e-3, kNoTurn = 1e-300;
constexpr int kPolarSteps = 3, kWithinThePlane[3] = {0, 2, 4};
using Rotation = double[3][3];

void product(const Rotation a, const Rotation b, Rotation out) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out[i][j] = a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j];
}

// Axis times angle, at most pi, of a rotation: by the largest component of its quaternion.
Vector turn_of(const Rotation r) {
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
void rotation_of(const Vector& turn, Rotation out) {
    const double angle = std::sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2]);
    const double scale = 1.0 / std::max(angle, kNoTurn), x = turn[0] * scale, y = turn[1] * scale, z = turn[2] * scale;
    const Rotation cross = {{0, -z, y}, {z, 0, -x}, {-y, x, 0}};
    Rotation square;
    product(cross, cross, square);
    const double sine = std::sin(angle), versine = 1.0 - std::cos(angle);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out[i][j] = (i == j) + sine * cross[i][j] + versine * square[i][j];
}

Vector mean_corner(const Probing& probe) {
    Vector mean{};
    const auto corners = probe.corners();
    for (const Vector& corner : corners)
        for (int d = 0; d < 3; ++d) mean[d] += corner[d] / double(corners.size());
    return mean;
}

// errors⁻¹ · pose, of rigid motions.
Pose undone(const Pose& error, const Pose& pose) {
    Pose told;
    const Vector off = {pose.origin[0] - error.origin[0], pose.origin[1] - error.origin[1],
                        pose.origin[2] - error.origin[2]};
    told.origin = error.turned_back(off);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            told.turn[i][j] =
                error.turn[0][i] * pose.turn[0][j] + error.turn[1][i] * pose.turn[1][j] + error.turn[2][i] * pose.turn[2][j];
    return told;
}

}  // namespace

FollowingTissue::Path::Path(const std::vector<Pose>& poses, const Probing& probe) : poses_(poses), own_(probe.corners()) {
    for (const Pose& pose : poses) corners_.push_back(corners_from(pose));
    std::vector<double> steps;
    for (size_t p = 1; p < corners_.size(); ++p) {
        double squares = 0;
        for (size_t k = 0; k < corners_[p].size(); ++k) squares += std::pow(corners_[p][k] - corners_[p - 1][k], 2);
        steps.push_back(std::sqrt(squares / double(own_.size())));
    }
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
    for (size_t p = 0; p < corners_.size(); ++p) {
        double sum = 0;
        for (size_t k = 0; k < asked.size(); ++k) sum += (asked[k] - corners_[p][k]) * (asked[k] - corners_[p][k]);
        squares.emplace_back(sum / double(own_.size()), p);
    }
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
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) mean.turn[i][j] += weight * poses_[frame].turn[i][j];
            mean.origin[i] += weight * poses_[frame].origin[i];
        }
    }
    for (int step = 0; step < kPolarSteps; ++step) {
        Rotation transposed, square, cube;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) transposed[i][j] = mean.turn[j][i];
        product(mean.turn, transposed, square);
        product(square, mean.turn, cube);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) mean.turn[i][j] = 1.5 * mean.turn[i][j] - 0.5 * cube[i][j];
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
    const Vector from = before.at(middle_), to = after.at(middle_);
    const Vector shift = before.turned_back({to[0] - from[0], to[1] - from[1], to[2] - from[2]});
    Rotation between;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            between[i][j] = before.turn[0][i] * after.turn[0][j] + before.turn[1][i] * after.turn[1][j] +
                            before.turn[2][i] * after.turn[2][j];
    const Vector turn = turn_of(between);
    return {shift[0], shift[1], shift[2], turn[0], turn[1], turn[2]};
}

Pose FollowingTissue::moved(const Pose& pose, const Way& way) const {
    Pose moved;
    Rotation turn;
    rotation_of({way[3], way[4], way[5]}, turn);
    product(pose.turn, turn, moved.turn);
    const Vector middle = pose.at({middle_[0] + way[0], middle_[1] + way[1], middle_[2] + way[2]});
    moved.origin = {0, 0, 0};
    const Vector off = moved.turned(middle_);
    for (int d = 0; d < 3; ++d) moved.origin[d] = middle[d] - off[d];
    return moved;
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
