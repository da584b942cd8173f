#include "pressing.hpp"

#include <algorithm>
#include <cmath>

namespace ultragray {
namespace {

constexpr double kCellMm = 3.0, kPi = 3.14159265358979323846;
constexpr int kMostCells = 1 << 22, kFillings = 4;
constexpr double kFaceWidthMm = 10.0;                     // along elevation, as most arrays have it with their housing
constexpr double kRowMm = 3.0;                            // between rows along elevation
constexpr double kBesideMm = 12.0, kMostBesideMm = 40.0;  // beyond the face, where the image is no wider, or is
constexpr double kRoundedMm = 1.5;                        // edges of the face
constexpr double kStiffest = 1e-3;   // compliance of layers of nothing but bone, over that of their stiffest tissue
constexpr double kMostStrain = 0.6;  // tissue that is compressed farther would turn inside out
constexpr float kMostUnlike = 5.0f;  // tissue over that of its layer
constexpr int kSweeps = 60;          // of the contact

constexpr double kFrictionMnPerMm = 11.0;  // of a needle in liver: Okamura, Simone and O'Leary, IEEE T-BME 51 (2004) 1707

// Elastic layers under a load cos(k x), x along the surface: displacements A(z) sin(k x) along it and W(z) cos(k x) into
// the depth are the least of the energy
//     1/2 ∫ λ (k A + W')² + 2 μ ((k A)² + W'²) + μ (A' − k W)² dz − P W(0),
// by linear elements with their strains in the middle, so that tissue that keeps its volume does not lock. Nodes are
// eliminated from the deepest, which is fixed, upwards.
struct Mesh {
    std::vector<double> lengths, compliances;  // of elements
};

struct Pair {
    double a, w;
};

void respond_to_wave(const Mesh& mesh, double k, int wanted, int every, Pair* out) {
    const int count = int(mesh.lengths.size());
    constexpr double nu = Press::kPoisson;
    std::vector<std::array<double, 4>> up(count), link(count);  // inverse of what is below, and its coupling upwards
    double d[3] = {};                                           // aa, aw, ww of the node above, from the element below it
    std::vector<std::array<double, 10>> elements(count);
    for (int n = 0; n < count; ++n) {
        const double l = mesh.lengths[n], young = 1.0 / mesh.compliances[n], mu = young / (2 * (1 + nu));
        const double lambda = young * nu / ((1 + nu) * (1 - 2 * nu));
        const double e[4] = {k / 2, -1 / l, k / 2, 1 / l}, h[4] = {k / 2, 0, k / 2, 0}, s[4] = {0, -1 / l, 0, 1 / l};
        const double g[4] = {-1 / l, -k / 2, 1 / l, -k / 2};
        int to = 0;
        for (int i = 0; i < 4; ++i)
            for (int j = i; j < 4; ++j)
                elements[n][to++] = l * (lambda * e[i] * e[j] + 2 * mu * (h[i] * h[j] + s[i] * s[j]) + mu * g[i] * g[j]);
    }
    // Entries of an element: 00 01 02 03 11 12 13 22 23 33.
    for (int n = count - 1; n >= 0; --n) {
        const auto& m = elements[n];
        double aa = m[0], aw = m[1], ww = m[4];
        if (n < count - 1) {  // the node below: its own stiffness, d, and that of this element
            const double p = d[0] + m[7], q = d[1] + m[8], r = d[2] + m[9], determinant = p * r - q * q;
            const std::array<double, 4> inverse = {r / determinant, -q / determinant, -q / determinant, p / determinant};
            const double b[4] = {m[2], m[3], m[5], m[6]};  // rows: the node above; columns: the one below
            std::array<double, 4>& c = link[n];            // -inverse bT
            c = {-(inverse[0] * b[0] + inverse[1] * b[1]), -(inverse[0] * b[2] + inverse[1] * b[3]),
                 -(inverse[2] * b[0] + inverse[3] * b[1]), -(inverse[2] * b[2] + inverse[3] * b[3])};
            aa += b[0] * c[0] + b[1] * c[2], aw += b[0] * c[1] + b[1] * c[3], ww += b[2] * c[1] + b[3] * c[3];
        }
        d[0] = aa, d[1] = aw, d[2] = ww;
    }
    const double determinant = d[0] * d[2] - d[1] * d[1];
    Pair at{-d[1] / determinant, d[0] / determinant};
    for (int n = 0, depth = 0; depth < wanted; ++n) {
        if (n % every == 0) out[depth++] = at;
        if (n >= count - 1) break;
        at = {link[n][0] * at.a + link[n][1] * at.w, link[n][2] * at.a + link[n][3] * at.w};
    }
}

}  // namespace

Compliance::Compliance(const float* means_mm, const uint8_t* labels, int64_t count, const float* by_label)
    : plain_(by_label[0]) {
    if (labels == nullptr || count == 0) return;
    double high[3];
    for (int d = 0; d < 3; ++d) low_[d] = high[d] = means_mm[d];
    for (int64_t i = 0; i < 3 * count; ++i) {
        low_[i % 3] = std::min<double>(low_[i % 3], means_mm[i]);
        high[i % 3] = std::max<double>(high[i % 3], means_mm[i]);
    }
    double volume = 1;
    for (int d = 0; d < 3; ++d) volume *= std::max(high[d] - low_[d], kCellMm);
    const double cell = std::max(kCellMm, std::cbrt(volume / kMostCells));
    per_mm_ = 1.0 / cell;
    for (int d = 0; d < 3; ++d) size_[d] = 1 + int((high[d] - low_[d]) / cell + 0.5);
    const size_t cells = size_t(size_[0]) * size_[1] * size_[2];
    std::vector<float> weights(cells), bones(cells);
    cells_.assign(cells, 0.0f);
    const auto index = [&](const int* at) { return (size_t(at[0]) * size_[1] + at[1]) * size_[2] + at[2]; };
    for (int64_t i = 0; i < count; ++i) {
        int at[3];
        for (int d = 0; d < 3; ++d) at[d] = int((means_mm[3 * i + d] - low_[d]) * per_mm_ + 0.5);
        const float compliance = by_label[labels[i]];
        (compliance > 0 ? weights : bones)[index(at)] += 1.0f;
        cells_[index(at)] += compliance;
    }
    std::vector<char> known(cells);
    for (size_t k = 0; k < cells; ++k) {
        known[k] = weights[k] + bones[k] > 0;
        cells_[k] = bones[k] > weights[k] ? 0.0f : known[k] ? cells_[k] / weights[k] : plain_;
    }
    for (int filling = 0; filling < kFillings; ++filling) {  // of what lies between Gaussians
        const std::vector<char> before = known;
        for (int i = 0; i < size_[0]; ++i)
            for (int j = 0; j < size_[1]; ++j)
                for (int k = 0; k < size_[2]; ++k) {
                    const int at[3] = {i, j, k};
                    if (before[index(at)]) continue;
                    float sum = 0;
                    int beside = 0;
                    for (int d = 0; d < 3; ++d)
                        for (int side = -1; side <= 1; side += 2) {
                            int to[3] = {i, j, k};
                            to[d] += side;
                            if (to[d] < 0 || to[d] >= size_[d] || !before[index(to)]) continue;
                            sum += cells_[index(to)], ++beside;
                        }
                    if (beside) cells_[index(at)] = sum / beside, known[index(at)] = 1;
                }
    }
}

float Compliance::at(const double* point_mm) const {
    size_t index = 0;
    if (cells_.empty()) return plain_;
    for (int d = 0; d < 3; ++d) {
        const double place = (point_mm[d] - low_[d]) * per_mm_ + 0.5;
        if (!(place >= 0) || place >= size_[d]) return plain_;
        index = index * size_[d] + size_t(place);
    }
    return cells_[index];
}

Press::Press(std::shared_ptr<const Compliance> compliance, const Face& face, const double* poses, int count)
    : compliance_(std::move(compliance)), face_(face) {
    const double breadth = std::max(face.breadth, kFaceWidthMm), depth = face.far - face.depth;
    strips_ = std::clamp(int(std::lround(breadth / 3.0)), 4, 20);
    pitch_ = breadth / strips_;
    const double beside = std::clamp(face.half_width - breadth / 2, kBesideMm, kMostBesideMm);
    columns_ = strips_ + 2 * int(std::ceil((face.curved ? kBesideMm : beside) / pitch_));
    depths_ = std::clamp(int(std::ceil(depth / 2.5)) + 4, 12, 36);
    step_ = depth / (depths_ - 4);
    // Of columns of tissue under the face: what lies behind bone does not give way, as the bone itself.
    layers_.assign(depths_ - 1, 0.0f);
    int seen = 0;
    for (int p = 0; p < count; p += std::max(1, count / 64)) {
        for (int i = 0; i < strips_; ++i, ++seen) {
            const double along = (i - 0.5 * (strips_ - 1)) * pitch_;
            for (int n = 0; n < depths_ - 1; ++n) {
                const auto at = place(along, (n + 0.5) * step_, 0.0);
                double point[3];
                for (int d = 0; d < 3; ++d)
                    point[d] = poses[16 * p + 4 * d + 3] + poses[16 * p + 4 * d] * at[0] + poses[16 * p + 4 * d + 2] * at[2];
                const float here = compliance_->at(point);
                if (here == 0.0f) break;
                layers_[n] += here;
            }
        }
    }
    const double nowhere[3] = {INFINITY, INFINITY, INFINITY};
    const float plain = compliance_->at(nowhere);
    for (float& layer : layers_) layer = seen ? std::max(layer / seen, float(kStiffest * plain)) : plain;
    respond();
}

// The displacement for 1 mN on one strip, a pitch wide, at columns beside it: the sum of waves over the surface. Across
// the face the load is that of a long rigid punch, p(y) ~ 1 / sqrt(1 − (y/a)²), of which the transform is J0(a k_y).
void Press::respond() {
    constexpr int kAlong = 96, kAcross = 64, kWaves = 256, kFine = 4, kLoads = 16;
    Mesh mesh;
    for (const float layer : layers_)
        for (int n = 0; n < kFine; ++n) mesh.lengths.push_back(step_ / kFine), mesh.compliances.push_back(layer);
    for (double l = step_ / kFine, below = 0; below < 4 * step_ * depths_; below += l) {  // and much deeper
        l *= 1.3;
        mesh.lengths.push_back(l), mesh.compliances.push_back(layers_.back());
    }
    const double most = 4.2 / kRoundedMm;  // wave numbers, per mm, spaced by squares: finest where the tissue gives most
    std::vector<Pair> waves(size_t(kWaves + 1) * depths_);
    for (int n = 0; n <= kWaves; ++n) {
        const double root = std::max(double(n) / kWaves, 1e-4);
        respond_to_wave(mesh, 1.5 * most * root * root, depths_, kFine, &waves[size_t(n) * depths_]);
    }
    const int rows = kRows / 2 + 1;
    responses_.assign(size_t(columns_) * rows * 3 * depths_, 0.0f);
    std::vector<double> across(size_t(rows) * 3 * depths_), wave(2 * depths_);
    for (int a = 0; a < kAlong; ++a) {
        const double ta = (a + 0.5) / kAlong, kx = most * ta * ta, dx = 2 * most * ta / kAlong;
        const double strip = kx * pitch_ / 2, by_strip = std::sin(strip) / strip;
        std::fill(across.begin(), across.end(), 0.0);
        for (int b = 0; b < kAcross; ++b) {
            const double tb = (b + 0.5) / kAcross, ky = most * tb * tb, dy = 2 * most * tb / kAcross;
            const double k = std::hypot(kx, ky), rounded = std::exp(-0.5 * std::pow(k * kRoundedMm, 2));
            double by_width = 0;
            for (int n = 0; n < kLoads; ++n)
                by_width += std::cos(0.5 * kFaceWidthMm * ky * std::cos(kPi * (n + 0.5) / kLoads)) / kLoads;
            const double at = std::min(std::sqrt(k / (1.5 * most)) * kWaves, kWaves - 1e-6);
            const Pair* between = &waves[size_t(at) * depths_];
            const double share = at - std::floor(at), load = by_strip * by_width * rounded * dx * dy / (kPi * kPi);
            for (int n = 0; n < depths_; ++n) {
                wave[n] = between[n].a + share * (between[n + depths_].a - between[n].a);
                wave[depths_ + n] = between[n].w + share * (between[n + depths_].w - between[n].w);
            }
            for (int row = 0; row < rows; ++row) {
                const double even = load * std::cos(ky * row * kRowMm), odd = load * std::sin(ky * row * kRowMm);
                double* to = &across[size_t(row) * 3 * depths_];
                for (int n = 0; n < depths_; ++n) {
                    to[n] += even * kx / k * wave[n];
                    to[depths_ + n] += odd * ky / k * wave[n];
                    to[2 * depths_ + n] += even * wave[depths_ + n];
                }
            }
        }
        for (int offset = 0; offset < columns_; ++offset) {
            const double even = std::cos(kx * offset * pitch_), odd = std::sin(kx * offset * pitch_);
            for (int row = 0; row < rows; ++row) {
                const double* from = &across[size_t(row) * 3 * depths_];
                float* to = &responses_[(size_t(offset) * rows + row) * 3 * depths_];
                for (int n = 0; n < 3 * depths_; ++n) to[n] += float((n < depths_ ? odd : even) * from[n]);
            }
        }
    }
}

std::array<double, 3> Press::place(double along, double depth, double indentation) const {
    const double out = face_.depth + depth - indentation;
    if (!face_.curved) return {along, 0.0, out};
    const double angle = along / std::max(face_.depth, 1e-3);
    return {out * std::sin(angle), 0.0, out * std::cos(angle)};
}

Pressed Press::at(const double* pose, const double* indentation_mm, int places, const std::vector<Shaft>& needles) const {
    std::vector<double> indentation(columns_);  // beside the face the skin goes on as it is at its edge
    for (int i = 0; i < columns_; ++i) {
        const double share = (std::clamp(i - margin(), 0, strips_ - 1) + 0.5) / strips_;
        indentation[i] = indentation_mm[std::min(int(share * places), places - 1)];
    }
    const Columns columns = columns_of(pose, indentation);
    const std::vector<double> load = load_of(columns, indentation);
    Pressed pressed = on_grid(pose, moved_by(columns, load), indentation, needles);
    for (const double one : load) pressed.force_n += 1e-3 * one;
    return pressed;
}

// What gives way in each column of tissue, over what its layer does: nothing from the first bone on.
Press::Columns Press::columns_of(const double* pose, const std::vector<double>& indentation) const {
    Columns found{std::vector<float>(size_t(columns_) * kRows * cells()),
                  std::vector<int>(size_t(columns_) * kRows, cells())};
    std::vector<float> spread(cells(), 1.0f);  // under a curved face the load spreads with the lines
    for (int n = 0; face_.curved && n < cells(); ++n) spread[n] = float(face_.depth / (face_.depth + (n + 0.5) * step_));
    for (int i = 0; i < columns_; ++i) {
        const auto first = place(along(i), 0.5 * step_, indentation[i]),
                   second = place(along(i), 1.5 * step_, indentation[i]);
        for (int j = 0; j < kRows; ++j) {
            const double y = (j - kRows / 2) * kRowMm;
            double point[3], step[3];
            for (int d = 0; d < 3; ++d) {
                const double* axis = pose + 4 * d;
                point[d] = axis[3] + axis[0] * first[0] + axis[1] * y + axis[2] * first[2];
                step[d] = axis[0] * (second[0] - first[0]) + axis[2] * (second[2] - first[2]);
            }
            float* to = &found.gives[(size_t(i) * kRows + j) * cells()];
            for (int n = 0; n < cells(); ++n) {
                const float here = compliance_->at(point);
                if (here == 0.0f) {
                    found.free[size_t(i) * kRows + j] = n;
                    break;
                }
                to[n] = std::min(here / layers_[n], kMostUnlike) * spread[n];
                for (int d = 0; d < 3; ++d) point[d] += step[d];
            }
        }
    }
    return found;
}

// How hard each strip of the face presses, mN: so that the skin under it gives way to where it is, and none is drawn by it.
std::vector<double> Press::load_of(const Columns& columns, const std::vector<double>& indentation) const {
    std::vector<double> sinks(size_t(strips_) * strips_), load(strips_);  // of strip i for a load on strip k
    for (int i = 0; i < strips_; ++i) {
        const size_t column = size_t(i + margin()) * kRows + kRows / 2;
        const float* gives = &columns.gives[column * cells()];
        for (int k = 0; k < strips_; ++k) {
            const float* down = response(std::abs(i - k), 0) + 2 * depths_;
            double sum = columns.free[column] == cells() ? down[cells()] : 0.0;
            for (int n = 0; n < cells(); ++n) sum += gives[n] * (down[n] - down[n + 1]);
            sinks[size_t(i) * strips_ + k] = sum + (i == k ? kStiffest * down[0] : 0.0);
        }
    }
    for (int sweep = 0; sweep < kSweeps; ++sweep)
        for (int i = 0; i < strips_; ++i) {
            const double* row = &sinks[size_t(i) * strips_];
            double left = indentation[i + margin()] + row[i] * load[i];
            for (int k = 0; k < strips_; ++k) left -= row[k] * load[k];
            load[i] = std::max(left / row[i], 0.0);
        }
    return load;
}

// Displacements along the arc, elevation and depth, mm: [columns, rows, 3, depths].
std::vector<float> Press::moved_by(const Columns& columns, const std::vector<double>& load) const {
    const int halves = kRows / 2 + 1;
    std::vector<float> sums(size_t(columns_) * halves * 3 * depths_), moved(size_t(columns_) * kRows * 3 * depths_);
    for (int i = 0; i < columns_; ++i)
        for (int row = 0; row < halves; ++row) {
            float* to = &sums[(size_t(i) * halves + row) * 3 * depths_];
            for (int k = 0; k < strips_; ++k) {
                const int offset = i - margin() - k;
                const float* from = response(std::abs(offset), row);
                const float by = float(load[k]), sideways = offset < 0 ? -by : by;
                for (int n = 0; n < depths_; ++n) to[n] += sideways * from[n];
                for (int n = depths_; n < 3 * depths_; ++n) to[n] += by * from[n];
            }
        }
    const float* under = response(0, 0) + 2 * depths_;
    for (int i = 0; i < columns_; ++i)
        for (int j = 0; j < kRows; ++j) {
            const size_t column = size_t(i) * kRows + j;
            const int first = columns.free[column];
            const float* from = &sums[(size_t(i) * halves + std::abs(j - kRows / 2)) * 3 * depths_];
            const float* gives = &columns.gives[column * cells()];
            float *sideways = &moved[column * 3 * depths_], *across = sideways + depths_, *down = across + depths_;
            down[cells()] = first == cells() ? from[3 * depths_ - 1] : 0.0f;
            for (int n = cells() - 1; n >= 0; --n) {
                const float shorter = gives[n] * (from[2 * depths_ + n] - from[2 * depths_ + n + 1]);
                down[n] = down[n + 1] + std::min(shorter, float(kMostStrain * step_));
            }
            for (int n = 0; n < depths_; ++n) {  // bone holds what lies on it
                const float held = first == cells() ? 1.0f : n < first ? 1.0f - under[first] / under[n] : 0.0f;
                sideways[n] = held * from[n];
                across[n] = (j < kRows / 2 ? -held : held) * from[depths_ + n];
            }
        }
    return moved;
}

// The same as splines on a straight grid in the axes of the probe, with a border that they need. The samples are taken as
// coefficients: what varies within a cell, such as at the edges of the face and of bone, is smoothed and does not ring.
Pressed Press::on_grid(const double* pose, const std::vector<float>& moved, const std::vector<double>& indentation,
                       const std::vector<Shaft>& needles) const {
    const double deepest = *std::max_element(indentation.begin(), indentation.end());
    const double side = 0.5 * (columns_ - 1) * pitch_, turn = face_.curved ? std::min(side / face_.depth, kPi / 2) : 0.0;
    const double half = face_.curved ? face_.far * std::sin(turn) : side;
    const double top = face_.depth * std::cos(turn) - deepest;
    const double spacing[3] = {2 * half / (size()[0] - 3), kRowMm, (face_.far - top) / cells()};
    const double origin[3] = {-half - spacing[0], -kRowMm * (kRows / 2 + 1), top - spacing[2]};
    Pressed pressed{{}, size(), {}, 0.0};
    for (int a = 0; a < 3; ++a) {
        double* row = &pressed.to_grid[4 * a];
        row[3] = -origin[a] / spacing[a];
        for (int d = 0; d < 3; ++d) row[d] = pose[4 * d + a] / spacing[a], row[3] -= row[d] * pose[4 * d + 3];
    }
    pressed.coefficients.resize(size_t(3) * pressed.size[0] * pressed.size[1] * pressed.size[2]);
    const size_t line = size_t(3) * depths_;
    for (int i = 0; i < pressed.size[0]; ++i)
        for (int k = 0; k < pressed.size[2]; ++k) {
            const double x = std::clamp(origin[0] + i * spacing[0], -half, half);
            const double z = std::clamp(origin[2] + k * spacing[2], top, face_.far);
            const double range = face_.curved ? std::hypot(x, z) : z, angle = face_.curved ? std::atan2(x, z) : 0.0;
            const double at = (face_.curved ? angle * face_.depth : x) / pitch_ + 0.5 * (columns_ - 1);
            const int column = std::clamp(int(at), 0, columns_ - 2);
            const float right = float(std::clamp(at - column, 0.0, 1.0));
            const double skin = indentation[column] + right * (indentation[column + 1] - indentation[column]);
            const double depth = std::clamp((range - face_.depth + skin) / step_, 0.0, double(cells()) - 1e-6);
            const float below = float(depth - int(depth)), sine = float(std::sin(angle)), cosine = float(std::cos(angle));
            for (int j = 0; j < pressed.size[1]; ++j) {
                const size_t row = size_t(column) * kRows + std::clamp(j - 1, 0, kRows - 1);
                float u[3];
                for (int d = 0; d < 3; ++d) {
                    const float* a = &moved[row * line + size_t(d) * depths_ + int(depth)];
                    const float* b = a + kRows * line;
                    const float left = a[0] + below * (a[1] - a[0]);
                    u[d] = left + right * (b[0] + below * (b[1] - b[0]) - left);
                }
                double own[3] = {u[0] * cosine + u[2] * sine, u[1], u[2] * cosine - u[0] * sine};
                const double point[3] = {x, (j - 1 - kRows / 2) * kRowMm, z};
                for (const Shaft& needle : needles) drag(pose, needle, point, own);
                float* to = &pressed.coefficients[3 * ((size_t(i) * pressed.size[1] + j) * pressed.size[2] + k)];
                for (int d = 0; d < 3; ++d)
                    to[d] = float(pose[4 * d] * own[0] + pose[4 * d + 1] * own[1] + pose[4 * d + 2] * own[2]);
            }
        }
    return pressed;
}

// Adds the displacement by a needle, in the axes of the probe: that of Kelvin's point force, integrated over the part of
// the shaft that is in the tissue, which it draws along by friction. Bone stays.
void Press::drag(const double* pose, const Shaft& needle, const double* point, double* moved) const {
    double shaft[3], length = 0, out[3], along = 0, squares = 0, tip[3], here[3];
    for (int d = 0; d < 3; ++d) {
        shaft[d] = needle.tip_mm[d] - needle.hub_mm[d], length += shaft[d] * shaft[d];
        tip[d] = pose[4 * d + 3], here[d] = pose[4 * d + 3];
        for (int a = 0; a < 3; ++a) tip[d] += pose[4 * d + a] * needle.tip_mm[a], here[d] += pose[4 * d + a] * point[a];
    }
    length = std::sqrt(length);
    if (compliance_->at(here) == 0.0f) return;
    for (int d = 0; d < 3; ++d) shaft[d] /= length, out[d] = point[d] - needle.hub_mm[d], along += out[d] * shaft[d];
    // From where it enters the tissue, at the depth of the face.
    const double before = shaft[2] > 0 ? std::clamp((face_.depth - needle.hub_mm[2]) / shaft[2], 0.0, length) : 0.0;
    for (int d = 0; d < 3; ++d) out[d] -= along * shaft[d], squares += out[d] * out[d];
    const double least = 0.5 * kRowMm, across = std::sqrt(squares + least * least);  // a line load would be infinite at it
    const double to_tip = length - along, from_entry = along - before;
    const double far_tip = std::hypot(to_tip, across), far_entry = std::hypot(from_entry, across);
    const double ways = std::asinh(to_tip / across) + std::asinh(from_entry / across);
    const double soft = std::max(compliance_->at(tip), float(kStiffest * layers_[0]));
    const double by = kFrictionMnPerMm * 2 * (1 + kPoisson) * soft / (16 * kPi * (1 - kPoisson));
    const double forwards = by * ((4 - 4 * kPoisson) * ways - to_tip / far_tip - from_entry / far_entry);
    const double sideways = by * (1 / far_tip - 1 / far_entry);
    for (int d = 0; d < 3; ++d) moved[d] += forwards * shaft[d] + sideways * out[d];
}

}  // namespace ultragray
