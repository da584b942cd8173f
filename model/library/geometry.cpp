#include "geometry.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace ultragray::library {
namespace {

constexpr double kRotationTolerance = 1e-3, kExact = 1e-14, kMostPosition = 1e6;
constexpr int kPolarSteps = 8;  // of Newton's iteration from within the tolerance: three would do
constexpr int kSquarings = 60;
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

double radians(double degrees) { return degrees * (kPi / 180.0); }

// The largest entry of RᵀR − 1.
double deviation_of(const Matrix& r) {
    const Matrix square = times(transposed(r), r);
    double most = 0;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            const double off = std::fabs(square[i][j] - (i == j));
            if (!(off <= most)) most = off;  // NaN is kept
        }
    return most;
}

// The nearest rotation, R ← R (3 − RᵀR) / 2.
void make_exact(Matrix& r) {
    for (int step = 0; step < kPolarSteps && deviation_of(r) > kExact; ++step) {
        Matrix half = times(transposed(r), r);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) half[i][j] = 0.5 * ((i == j) * 3.0 - half[i][j]);
        r = times(r, half);
    }
}

}  // namespace

Vector perpendicular(const Vector& v) {
    int flattest = 0;
    for (int d = 1; d < 3; ++d)
        if (std::fabs(v[d]) < std::fabs(v[flattest])) flattest = d;
    Vector unit{};
    unit[flattest] = 1.0;
    const Vector found = cross(v, unit);
    return times(found, 1.0 / length(found));
}

Pose Pose::read(const double* matrix, const std::string& name) {
    Pose pose;
    for (int i = 0; i < 16; ++i)
        if (!std::isfinite(matrix[i])) throw Fault(name + " must be finite, got NaN or infinity");
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) pose.turn[i][j] = matrix[4 * i + j];
        pose.origin[i] = matrix[4 * i + 3];
        if (std::fabs(pose.origin[i]) > kMostPosition) throw Fault(name + " must lie within 1e+06 mm");
        if (std::fabs(matrix[12 + i]) > kRotationTolerance) throw Fault(name + " must end in the row 0 0 0 1");
    }
    if (std::fabs(matrix[15] - 1.0) > kRotationTolerance) throw Fault(name + " must end in the row 0 0 0 1");
    const double deviation = deviation_of(pose.turn);
    if (!(deviation <= kRotationTolerance))
        throw Fault(name + " must hold a rotation: the largest entry of RᵀR − 1 must be at most 0.001, got " +
                    in_words(deviation));
    if (dot(cross(pose.axis(0), pose.axis(1)), pose.axis(2)) <= 0)
        throw Fault(name + " must hold a rotation with determinant +1, got a mirrored one (−1)");
    if (deviation > kExact) make_exact(pose.turn);
    return pose;
}

std::array<double, 16> Pose::matrix() const {
    std::array<double, 16> rows{};
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) rows[4 * i + j] = turn[i][j];
        rows[4 * i + 3] = origin[i];
    }
    rows[15] = 1.0;
    return rows;
}

void quaternion_products(const Matrix& r, double products[4][4]) {
    const double trace = r[0][0] + r[1][1] + r[2][2];
    const double odd[3] = {r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]};
    products[0][0] = 1.0 + trace;
    for (int i = 0; i < 3; ++i) {
        products[0][i + 1] = products[i + 1][0] = odd[i];
        for (int j = 0; j < 3; ++j) products[i + 1][j + 1] = r[i][j] + r[j][i] + (i == j ? 1.0 - trace : 0.0);
    }
}

// Of all rotations, the nearest to a mean of some is that of the quaternion q which has the largest qᵀ K q, K being the
// mean of their products: by squaring K until nothing but that eigenvector's product is left.
Matrix mean_axes(const std::vector<Pose>& poses) {
    Matrix mean{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
    double k[4][4], square[4][4];
    for (int i = 0; i < 3 && !poses.empty(); ++i) {
        mean[i] = {};
        for (const Pose& pose : poses) mean[i] = plus(mean[i], pose.turn[i]);
        for (double& one : mean[i]) one /= double(poses.size());
    }
    quaternion_products(mean, k);
    for (int step = 0; step < kSquarings; ++step) {
        const double trace = k[0][0] + k[1][1] + k[2][2] + k[3][3];
        for (auto& row : k)
            for (double& one : row) one /= trace;
        for (int i = 0; i < 4; ++i)
            for (int j = 0; j < 4; ++j)
                square[i][j] = k[i][0] * k[0][j] + k[i][1] * k[1][j] + k[i][2] * k[2][j] + k[i][3] * k[3][j];
        std::copy(&square[0][0], &square[0][0] + 16, &k[0][0]);
    }
    int largest = 0;
    for (int i = 1; i < 4; ++i)
        if (k[i][i] > k[largest][largest]) largest = i;
    const double* q = k[largest];
    const double norm2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3], w = q[0], x = q[1], y = q[2], z = q[3];
    Matrix axes{{{w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)},
                 {2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)},
                 {2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z}}};
    for (Vector& row : axes)
        for (double& one : row) one /= norm2;
    return axes;
}

namespace {

// A case for each kind: one without does not compile.
struct ProbingOf {
    using Lines = Probing::Lines;
    Probing operator()(const ConvexProbe& p) const {
        return {Lines::Fanned, p.opening_angle_deg, 0.0, p.near_mm, p.far_mm, p.near_mm};
    }
    Probing operator()(const PhasedProbe& p) const {
        return {Lines::Fanned, p.opening_angle_deg, 0.0, p.near_mm, p.far_mm, p.near_mm};
    }
    Probing operator()(const RadialProbe& p) const { return {Lines::Radial, 360.0, 0.0, p.near_mm, p.far_mm, p.near_mm}; }
    Probing operator()(const LinearProbe& p) const {
        return {Lines::Parallel, p.width_mm, 0.0, p.near_mm, p.far_mm, p.face_depth_mm};
    }
    Probing operator()(const SteeredProbe& p) const {
        return {Lines::Parallel, p.width_mm, p.steering_deg, p.near_mm, p.far_mm, p.face_depth_mm};
    }
};

}  // namespace

Probing Probing::of(const Probe& probe) { return std::visit(ProbingOf{}, probe); }

Probing Probing::ending_at(double far) const {
    Probing other = *this;
    other.far_mm = far;
    return other;
}

double Probing::breadth_mm(double depth) const { return is_angular() ? depth * radians(span) : span; }

double Probing::half_width_mm() const {
    double half = 0;
    for (const Vector& corner : corners()) half = std::max(half, std::fabs(corner[0]));
    return half;
}

Ray Probing::ray(double across) const {
    const double angle = radians(is_angular() ? across : steering_deg);
    return {{is_angular() ? 0.0 : across, 0.0, 0.0}, {std::sin(angle), 0.0, std::cos(angle)}};
}

Vector Probing::point(double row, double column) const {
    return ray(start() + span * column).at(near_mm + length_mm() * row);
}

std::vector<Vector> Probing::corners() const {
    std::vector<double> shares = {0.0, 1.0};
    if (lines == Lines::Fanned) shares = {0.0, 0.5, 1.0};
    if (lines == Lines::Radial) shares = {0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875};
    std::vector<Vector> found;
    for (const double row : {0.0, 1.0})
        for (const double share : shares) found.push_back(point(row, share));
    return found;
}

Place Probing::place(double x, double z) const {
    if (lines == Lines::Parallel) {
        const double along_x = std::sin(radians(steering_deg)), along_z = std::cos(radians(steering_deg));
        return {z / along_z, x - z * (along_x / along_z)};
    }
    const double angle = std::atan2(x, z) * (180.0 / kPi);
    if (lines == Lines::Fanned) return {z > 0 ? std::hypot(x, z) : kNaN, angle};
    return {std::hypot(x, z), angle < 0 ? angle + span : angle};
}

void Probing::kernel_pose(const Pose& pose_cm, double matrix[16]) const {
    double axis[3] = {0.0, 0.0, 1.0};  // of depth, in the axes of the pose
    if (lines == Lines::Parallel) {
        const double along_x = std::sin(radians(steering_deg)), along_z = std::cos(radians(steering_deg));
        axis[0] = -along_x / along_z, axis[2] = 1.0 / along_z;
    }
    std::fill(matrix, matrix + 16, 0.0);
    for (int i = 0; i < 3; ++i) {
        const Vector& row = pose_cm.turn[i];
        matrix[4 * i] = row[0] + row[2] * axis[0];
        matrix[4 * i + 1] = row[1];
        matrix[4 * i + 2] = row[2] * axis[2];
        matrix[4 * i + 3] = pose_cm.origin[i];
    }
    matrix[15] = 1.0;
}

namespace {

Beam kernel_beam(const std::optional<ElevationBeam>& beam, double near_cm, double far_cm, double face_mm) {
    if (!beam || beam->thickness_mm == 0.0) return {0.0, 0.0, 0.0, 0.0};
    const double sigma = beam->thickness_mm / (10.0 * kFwhmPerSigma);
    const double focus = (beam->focus_mm.value_or(0.0) + face_mm) / 10.0;
    const double slope = beam->depth_of_field_mm ? sigma / (*beam->depth_of_field_mm / 20.0) : 0.0, slope2 = slope * slope;
    const double offset = slope2 != 0.0 ? std::max(std::fabs(near_cm - focus), std::fabs(far_cm - focus)) : 0.0;
    return {sigma * sigma, focus, slope2, sigma * sigma + slope2 * (offset * offset)};
}

}  // namespace

ProbeGeometry Probing::kernel(int height, const std::optional<ElevationBeam>& beam) const {
    const double near_cm = near_mm / 10.0;
    const double cull_mm =
        height == 1 ? std::numeric_limits<double>::infinity() : near_mm + length_mm() * (height - 1) / height;
    const Beam thick = kernel_beam(beam, near_cm, cull_mm / 10.0, face_mm);
    if (is_angular()) return {true, wraps(), radians(start()), radians(span), near_cm, far_mm / 10.0, cull_mm / 10.0, thick};
    return {false, false, start() / 10.0, span / 10.0, near_cm, far_mm / 10.0, cull_mm / 10.0, thick};
}

Picture Picture::of_frame(const Probing& probe, int height, int width) {
    const double column = probe.span / width, row = probe.length_mm() / height;
    return {height,
            width,
            probe.is_angular() ? "deg" : "mm",
            {probe.start() + column / 2, probe.near_mm + row / 2},
            {column, row}};
}

Picture Picture::of_plane(const Probing& probe, double pixel_mm) {
    double left, right, top, bottom;  // the smallest rectangle that holds the image
    if (probe.lines == Probing::Lines::Radial) {
        left = top = -probe.far_mm, right = bottom = probe.far_mm;
    } else if (probe.lines == Probing::Lines::Fanned) {
        const double half = radians(probe.span / 2);
        right = probe.far_mm * std::sin(half), left = -right;
        top = probe.near_mm * std::cos(half), bottom = probe.far_mm;
    } else {
        const double along_x = std::sin(radians(probe.steering_deg)), along_z = std::cos(radians(probe.steering_deg));
        left = std::min(probe.near_mm * along_x, probe.far_mm * along_x) - probe.span / 2;
        right = std::max(probe.near_mm * along_x, probe.far_mm * along_x) + probe.span / 2;
        top = probe.near_mm * along_z, bottom = probe.far_mm * along_z;
    }
    const double columns = std::max(1.0, std::ceil((right - left) / pixel_mm));
    const double rows = std::max(1.0, std::ceil((bottom - top) / pixel_mm));
    constexpr double kMostSide = 4096;
    if (columns > kMostSide || rows > kMostSide)
        throw Fault("display.pixel_mm must leave a picture at most 4096 pixels on a side, pixels of " + in_words(pixel_mm) +
                    " mm make it " + in_words(rows) + "x" + in_words(columns));
    return {int(rows),
            int(columns),
            "mm",
            {(left + right) / 2 + (1 - columns) * pixel_mm / 2, top + pixel_mm / 2},
            {pixel_mm, pixel_mm}};
}

}  // namespace ultragray::library
