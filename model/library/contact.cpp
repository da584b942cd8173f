#include "contact.hpp"

#include <algorithm>
#include <limits>

namespace ultragray::library {
namespace {

constexpr double kCouplingMm = 1.0, kMarginMm = 15.0, kLeastSlope = 0.2, kLeastAgreement = 0.6, kLeastCellMm = 1.0;
constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kAlongTheSkin = 1e-6, kMetMm = 1e-3;
constexpr int kMostCells = 256, kMostViews = 4096, kSettled = 8, kSteps = 6, kBlurred = 2;
// Of a way over a cell and over two, as on a chessboard's rook, bishop and knight: what OpenCV takes for distances that
// have labels, with 16 bits after the point.
constexpr uint32_t kStraight = 65536, kDiagonal = 91750, kKnight = 143976, kFar = UINT32_MAX >> 2;
struct Step {
    int row, column;
    uint32_t way;
};
constexpr Step kBefore[8] = {{-2, -1, kKnight},  {-2, 1, kKnight},   {-1, -2, kKnight}, {-1, -1, kDiagonal},
                             {-1, 0, kStraight}, {-1, 1, kDiagonal}, {-1, 2, kKnight},  {0, -1, kStraight}};

// Of each cell that one which was met and is nearest, and the way to it in cells.
void find_nearest(const std::vector<bool>& met, int rows, int columns, std::vector<int>& nearest, std::vector<float>& away) {
    std::vector<uint32_t> way(met.size(), kFar);
    nearest.assign(met.size(), 0);
    for (size_t k = 0; k < met.size(); ++k)
        if (met[k]) way[k] = 0, nearest[k] = int(k);
    const auto look = [&](int row, int column, int sign) {
        const size_t at = size_t(row) * columns + column;
        for (const Step& step : kBefore) {
            const int i = row + sign * step.row, j = column + sign * step.column;
            if (i < 0 || i >= rows || j < 0 || j >= columns) continue;
            const size_t from = size_t(i) * columns + j;
            if (way[from] + step.way < way[at]) way[at] = way[from] + step.way, nearest[at] = nearest[from];
        }
    };
    for (int row = 0; row < rows; ++row)
        for (int column = 0; column < columns; ++column) look(row, column, 1);
    for (int row = rows - 1; row >= 0; --row)
        for (int column = columns - 1; column >= 0; --column) look(row, column, -1);
    for (const uint32_t one : way) away.push_back(float(one) / float(kStraight));
}

// The mean of 5x5 cells, mirrored at the borders about the outermost ones.
std::vector<float> blurred(const std::vector<float>& heights, int rows, int columns) {
    const auto mirrored = [](int at, int count) { return at < 0 ? -at : at >= count ? 2 * count - 2 - at : at; };
    std::vector<double> across(heights.size());
    std::vector<float> mean(heights.size());
    for (int row = 0; row < rows; ++row)
        for (int column = 0; column < columns; ++column)
            for (int k = -kBlurred; k <= kBlurred; ++k)
                across[size_t(row) * columns + column] += heights[size_t(row) * columns + mirrored(column + k, columns)];
    for (int row = 0; row < rows; ++row)
        for (int column = 0; column < columns; ++column) {
            double sum = 0;
            for (int k = -kBlurred; k <= kBlurred; ++k) sum += across[size_t(mirrored(row + k, rows)) * columns + column];
            mean[size_t(row) * columns + column] = float(sum * (1.0 / 25.0));
        }
    return mean;
}

}  // namespace

Skin::Skin(const std::vector<Pose>& poses, const std::optional<Probe>& given) {
    if (!given || poses.empty())
        throw Fault("contact needs a scene that knows its training poses and their probe; this one does not");
    const Probing probe = Probing::of(*given);
    std::vector<Pose> views;
    const size_t every = std::max<size_t>(1, (poses.size() + kMostViews - 1) / kMostViews);
    for (size_t p = 0; p < poses.size(); p += every) views.push_back(poses[p]);
    Vector down{};
    for (const Pose& view : views) down = plus(down, view.axis(2));
    down = times(down, 1.0 / double(views.size()));
    if (probe.wraps() || length(down) < kLeastAgreement)
        throw Fault(
            "contact needs a scene whose training views look into the body from one side; those of this one look all "
            "around");
    const Vector out = times(down, -1.0 / length(down)), lateral = views[views.size() / 2].axis(0);
    Vector along = minus(lateral, times(out, dot(lateral, out)));
    if (length(along) < kAlongTheSkin) along = perpendicular(out);  // a view that looks along it
    axes_[0] = times(along, 1.0 / length(along)), axes_[1] = cross(out, axes_[0]), axes_[2] = out;

    const int count = 2 + int(std::ceil(probe.breadth_mm(probe.face_mm) / kLeastCellMm));
    std::vector<Vector> points;
    for (const Pose& view : views)
        for (int k = 0; k < count; ++k) {
            const Ray ray = probe.ray(probe.start() + probe.span * (double(k) / (count - 1)));
            points.push_back(times(axes_, view.at(ray.at(probe.face_mm))));
        }
    settle(points);
}

// Lays the cells over the points of the faces, mm along the axes: each has the heights that it met, or smoothed ones of
// those around it.
void Skin::settle(const std::vector<Vector>& points) {
    double low[2] = {kInfinity, kInfinity}, high[2] = {-kInfinity, -kInfinity};
    for (const Vector& point : points)
        for (int d = 0; d < 2; ++d) low[d] = std::min(low[d], point[d]), high[d] = std::max(high[d], point[d]);
    for (int d = 0; d < 2; ++d) low[d] -= kMarginMm, high[d] += kMarginMm - low[d];  // the latter now the extent
    cell_mm_ = std::max(kLeastCellMm, std::max(high[0], high[1]) / (kMostCells - 1));
    columns_ = int(std::ceil(high[0] / cell_mm_)) + 1, rows_ = int(std::ceil(high[1] / cell_mm_)) + 1;
    origin_ = plus(times(axes_[0], low[0]), times(axes_[1], low[1]));

    const size_t cells = size_t(rows_) * columns_;
    std::vector<bool> met(cells);
    outermost_.assign(cells, -std::numeric_limits<float>::infinity());
    innermost_.assign(cells, std::numeric_limits<float>::infinity());
    for (const Vector& point : points) {
        const int column = int(std::nearbyint((point[0] - low[0]) / cell_mm_));
        const size_t at = size_t(std::nearbyint((point[1] - low[1]) / cell_mm_)) * columns_ + column;
        met[at] = true;
        outermost_[at] = std::max(outermost_[at], float(point[2]));
        innermost_[at] = std::min(innermost_[at], float(point[2]));
    }
    std::vector<int> nearest;
    std::vector<float> away;
    find_nearest(met, rows_, columns_, nearest, away);
    for (const float way : away) known_.push_back(way * float(cell_mm_) <= float(kMarginMm));
    for (std::vector<float>* heights : {&outermost_, &innermost_}) {
        std::vector<float> filled(cells);
        for (size_t k = 0; k < cells; ++k) filled[k] = (*heights)[nearest[k]];
        for (int step = 0; step < kSettled; ++step) {
            filled = blurred(filled, rows_, columns_);
            for (size_t k = 0; k < cells; ++k)
                if (met[k]) filled[k] = (*heights)[k];
        }
        *heights = filled;
    }
}

// By Newton's method, of all points together: until none of them moves any farther.
std::vector<double> Skin::distances_mm(const std::vector<Vector>& points, const std::vector<Vector>& directions,
                                       Side side) const {
    const std::vector<float>& heights = side == Side::Outermost ? outermost_ : innermost_;
    std::vector<Vector> places, ways;
    for (size_t k = 0; k < points.size(); ++k) {
        places.push_back(times(axes_, minus(points[k], origin_)));
        ways.push_back(times(axes_, directions[k]));
    }
    std::vector<double> along(points.size());
    double most = kInfinity;
    for (int step = 0; step < kSteps && !(most < kMetMm); ++step) {
        most = 0;
        for (size_t k = 0; k < points.size(); ++k) {
            const Vector at = plus(places[k], times(ways[k], along[k]));
            const double y = std::clamp(at[1] / cell_mm_, 0.0, rows_ - 1.001);  // beyond the cells, of the outermost ones
            const double x = std::clamp(at[0] / cell_mm_, 0.0, columns_ - 1.001);
            const int i = int(y), j = int(x);
            const float* cell = &heights[size_t(i) * columns_ + j];
            const double down = y - i, right = x - j;
            const double upper = cell[0] * (1 - right) + cell[1] * right;
            const double lower = cell[columns_] * (1 - right) + cell[columns_ + 1] * right;
            const double off = (at[2] - (upper * (1 - down) + lower * down)) / std::min(ways[k][2], -kLeastSlope);
            along[k] -= off;
            most = std::max(most, std::fabs(off));
        }
    }
    for (size_t k = 0; k < points.size(); ++k) {
        const Vector at = plus(places[k], times(ways[k], along[k]));
        const double column = std::nearbyint(at[0] / cell_mm_), row = std::nearbyint(at[1] / cell_mm_);
        const bool inside = row >= 0 && row < rows_ && column >= 0 && column < columns_ && ways[k][2] <= -kLeastSlope;
        if (!inside || !known_[size_t(row) * columns_ + size_t(column)]) along[k] = kInfinity;
    }
    return along;
}

Touch::Touch(const Skin& skin, const Probing& probe, const Pose& pose, int width) : lines(width), depths_mm(width) {
    std::vector<Vector> faces, directions;
    for (int j = 0; j < width; ++j) {
        const Ray ray = probe.ray(probe.across(j, width));
        faces.push_back(pose.at(ray.at(probe.face_mm)));
        directions.push_back(pose.turned(ray.direction));
    }
    const std::vector<double> gaps = skin.distances_mm(faces, directions, Skin::Side::Outermost);
    const std::vector<double> ways = skin.distances_mm(faces, directions, Skin::Side::Innermost);
    for (int j = 0; j < width; ++j) {
        lines[j] = gaps[j] <= kCouplingMm;
        depths_mm[j] = lines[j] && std::isfinite(ways[j]) ? std::max(-ways[j], 0.0) : 0.0;
    }
    count = int(std::count(lines.begin(), lines.end(), true));
}

}  // namespace ultragray::library
