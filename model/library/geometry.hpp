// Poses, probes and pictures: where each pixel lies (ultragray.geometry says what the words mean). Lengths are mm.
#pragma once

#include <array>
#include <cmath>
#include <vector>

#include "../kernels/render.hpp"
#include "contract.hpp"

namespace ultragray::library {

constexpr double kPi = 3.14159265358979323846, kFwhmPerSigma = 2.3548200450309493;  // 2 sqrt(2 log 2)

using Vector = std::array<double, 3>;
using Matrix = std::array<Vector, 3>;  // rows

inline double dot(const Vector& a, const Vector& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline Vector minus(const Vector& a, const Vector& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
inline Vector plus(const Vector& a, const Vector& b) { return {a[0] + b[0], a[1] + b[1], a[2] + b[2]}; }
inline Vector times(const Vector& a, double s) { return {a[0] * s, a[1] * s, a[2] * s}; }
inline Vector cross(const Vector& a, const Vector& b) {
    return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}
inline double length(const Vector& a) { return std::sqrt(dot(a, a)); }
inline Vector times(const Matrix& m, const Vector& v) { return {dot(m[0], v), dot(m[1], v), dot(m[2], v)}; }
inline Matrix transposed(const Matrix& m) {
    return {{{m[0][0], m[1][0], m[2][0]}, {m[0][1], m[1][1], m[2][1]}, {m[0][2], m[1][2], m[2][2]}}};
}
inline Matrix times(const Matrix& a, const Matrix& b) {
    const Matrix columns = transposed(b);
    return {times(columns, a[0]), times(columns, a[1]), times(columns, a[2])};
}
Vector perpendicular(const Vector& v);  // some unit vector at right angles to another

// A rigid transform from the probe to the scene, and the point that a point goes to.
struct Pose {
    Matrix turn;
    Vector origin;

    // Of a matrix [4, 4], row by row; a rotation within 1e-3 of a proper one becomes it. `name` is the caller's. Throws
    // Fault.
    static Pose read(const double* matrix, const std::string& name);
    std::array<double, 16> matrix() const;
    Vector turned(const Vector& v) const { return times(turn, v); }
    Vector turned_back(const Vector& v) const { return times(transposed(turn), v); }
    Vector at(const Vector& point) const { return plus(turned(point), origin); }
    Vector axis(int which) const { return {turn[0][which], turn[1][which], turn[2][which]}; }  // lateral, elevation, axial
};

// 4 q qᵀ of the unit quaternion q of a rotation.
void quaternion_products(const Matrix& rotation, double products[4][4]);
// The lateral, elevation and axial directions (columns) of the rotation nearest to the mean of the poses' rotations.
Matrix mean_axes(const std::vector<Pose>& poses);

// A point of the image plane by its scan line: the depth along it, and its place `across`, mm or degrees.
struct Place {
    double depth, across;  // a depth of NaN: no line comes by
};

// A scan line in the probe's frame: its point of depth 0, and its unit direction.
struct Ray {
    Vector origin, direction;
    Vector at(double depth) const { return plus(origin, times(direction, depth)); }
};

// A probe, whatever its kind: its bundle of scan lines from `near_mm` to `far_mm`, and the depth of its face.
struct Probing {
    enum class Lines { Parallel, Fanned, Radial } lines;
    double span;  // of all lines, mm or degrees
    double steering_deg;
    double near_mm, far_mm, face_mm;

    static Probing of(const Probe& probe);
    Probing ending_at(double far) const;
    bool is_angular() const { return lines != Lines::Parallel; }
    bool wraps() const { return lines == Lines::Radial; }
    double start() const { return wraps() ? 0.0 : -span / 2; }
    double length_mm() const { return far_mm - near_mm; }
    double depth_mm(int row, int height) const { return near_mm + length_mm() * (row + 0.5) / height; }
    double breadth_mm(double depth) const;  // of a row of the image
    double half_width_mm() const;           // of the image, where it is widest
    double across(double column, int width) const { return start() + span * ((column + 0.5) / width); }
    Ray ray(double across) const;
    Vector point(double row, double column) const;  // of image coordinates from 0 to 1, in the probe's frame
    std::vector<Vector> corners() const;
    Place place(double x, double z) const;
    // The axes of a pose in cm as the kernels take them: parallel lines run along z in a sheared plane.
    void kernel_pose(const Pose& pose_cm, double matrix[16]) const;
    ProbeGeometry kernel(int height, const std::optional<ElevationBeam>& beam) const;
};

// A grid of pixels in the image plane: see Picture in ultragray.geometry.probe.
struct Picture {
    int height, width;
    std::string column_unit;
    double first[2], step[2];  // column and row

    static Picture of_frame(const Probing& probe, int height, int width);
    static Picture of_plane(const Probing& probe, double pixel_mm);
};

}  // namespace ultragray::library
