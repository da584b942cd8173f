#include "tools.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace ultragray::library {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kBeamMm = 2.5, kLeastSliceSigmaMm = 0.1, kLeastSpacingMm = 1e-6, kLeast = 1e-9, kLeastNeedle = 1e-12;
constexpr double kMostStopped = 1.0 - 1e-6;
constexpr double kLayers[5] = {-1.2816, -0.5244, 0.0, 0.5244, 1.2816};  // sigma: the middles of fifths of the slice
constexpr float kLeastSeen = 1.0f / 255.0f, kLabelled = 0.25f, kLeastBeam = 1e-6f;
constexpr float kByPulse = float(0.5 / (0.15 * 0.15));  // of the squared distance from a surface, 1/mm2
constexpr float kHeadOnSigmaDeg = 20.0f;

template <class Shape>
double thickness_of(const Shape& tool) {
    if constexpr (std::is_same_v<Shape, Box>)
        return std::min({tool.size_mm[0], tool.size_mm[1], tool.size_mm[2]});
    else
        return tool.diameter_mm;
}

template <class Shape>
double stopped_by(const Shape& tool, double path_mm) {
    return std::min(1.0 - std::pow(1.0 - tool.opacity, path_mm / thickness_of(tool)), kMostStopped);
}

// The share of a scan line as wide as the spacing that lies within half of a middle that is a gap away.
double covered(double gap, double half, double spacing) { return std::clamp((half - gap) / spacing + 0.5, 0.0, 1.0); }

// The share of a Gaussian beam that lies between two elevations.
double beam_share(double low, double high, double sigma) {
    const double scale = 1.0 / (std::sqrt(2.0) * sigma);
    return 0.5 * (std::erf(high * scale) - std::erf(low * scale));
}

// The part of a line that lies within a body; none where it leaves before it enters.
struct Span {
    double enters, leaves, head_on;  // the last: cosine of the angle to the normal of the side where it enters
};

Span overlap(const Span& one, const Span& other) {
    return {std::max(one.enters, other.enters), std::min(one.leaves, other.leaves),
            one.enters >= other.enters ? one.head_on : other.head_on};
}

Span between_planes(double place, double step, double half) {
    const double steep = std::fabs(step) < kLeast ? kLeast : step, a = (-half - place) / steep, b = (half - place) / steep;
    return {std::min(a, b), std::max(a, b), std::fabs(step)};
}

Span within_radius(const Vector& place, const Vector& step, double radius) {
    const double a = std::max(step[0] * step[0] + step[1] * step[1], kLeast * kLeast);
    const double b = place[0] * step[0] + place[1] * step[1],
                 c = place[0] * place[0] + place[1] * place[1] - radius * radius;
    const bool hits = b * b > a * c;
    const double root = std::sqrt(hits ? b * b - a * c : 0.0), enters = (-b - root) / a;
    const double x = place[0] + enters * step[0], y = place[1] + enters * step[1];
    return {enters, hits ? (-b + root) / a : -kInfinity, std::min(std::fabs(x * step[0] + y * step[1]) / radius, 1.0)};
}

// A body's middle and its own axes (rows), in the frame of its points.
struct Body {
    Vector middle;
    Matrix axes;
};

Body body_of(const Box& box) {
    const auto& q = box.quaternion;
    const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const double w = q[0] / norm, x = q[1] / norm, y = q[2] / norm, z = q[3] / norm;
    return {box.centre_mm,
            {{{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
              {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
              {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}}}};
}

Body body_of(const Cylinder& cylinder) {
    const Vector way = minus(cylinder.hub_mm, cylinder.tip_mm), axis = times(way, 1.0 / length(way));
    const Vector aside = perpendicular(axis);
    return {times(plus(cylinder.tip_mm, cylinder.hub_mm), 0.5), {cross(aside, axis), aside, axis}};
}

Span span_of(const Box& box, const Vector& place, const Vector& step) {
    Span span = between_planes(place[0], step[0], 0.5 * box.size_mm[0]);
    for (int d = 1; d < 3; ++d) span = overlap(span, between_planes(place[d], step[d], 0.5 * box.size_mm[d]));
    return span;
}

Span span_of(const Cylinder& cylinder, const Vector& place, const Vector& step) {
    const double half = 0.5 * length(minus(cylinder.hub_mm, cylinder.tip_mm));
    return overlap(within_radius(place, step, 0.5 * cylinder.diameter_mm), between_planes(place[2], step[2], half));
}

// [lines][layers]: solids by five layers of the slice, a needle by one.
using Crossings = std::vector<std::vector<Crossing>>;

template <class Solid>
Crossings crossings_of(const Solid& tool, const ScanView& view) {
    const Body body = body_of(tool);
    const Vector middle = view.seen(tool.frame, body.middle);
    Matrix axes;
    for (int d = 0; d < 3; ++d) axes[d] = minus(view.seen(tool.frame, plus(body.middle, body.axes[d])), middle);
    const double face = view.probe.face_mm;
    Crossings found;
    for (const ScanView::Line& line : view.lines) {
        const double slice = view.slice_mm(dot(minus(middle, line.origin), line.along));
        std::vector<Crossing>& layers = found.emplace_back();
        for (const double layer : kLayers) {
            const Vector start = plus(minus(line.origin, middle), {0.0, layer * slice, 0.0});
            const Span span = span_of(tool, times(axes, start), times(axes, line.along));
            double enters = std::max(span.enters, face), path = kLeast;
            const bool met = span.leaves > enters;
            if (met)
                path = span.leaves - enters;
            else
                enters = face;
            const double slant = std::sqrt(std::max(1.0 - span.head_on * span.head_on, 0.0));
            // By as much the side lies higher or lower half a line away.
            const double rise = std::min(0.5 * view.spacing_mm(enters) * slant / std::max(span.head_on, kLeast), path);
            layers.push_back({met / 5.0, std::max(enters - rise, face), enters + rise, std::max(path - rise, 0.0),
                              std::max(enters - rise, face), std::max(enters + rise, enters + path), path, slant,
                              stopped_by(tool, path)});
        }
    }
    return found;
}

// The part of low <= q <= high where slope q <= most; low > high where there is none.
void bound(double& low, double& high, double slope, double most) {
    const double limit = most / (std::fabs(slope) < kLeastNeedle ? kLeastNeedle : slope);
    if (slope <= -kLeastNeedle)
        low = std::max(low, limit);
    else
        high = std::min(high, limit);
}

// Of each line the point of the shaft that is nearest, as Needle.crossing explains.
Crossings crossings_of(const Needle& needle, const ScanView& view) {
    const Vector tip = view.seen(needle.frame, needle.tip_mm), hub = view.seen(needle.frame, needle.hub_mm);
    const double far = length(minus(hub, tip)), radius = 0.5 * needle.diameter_mm, face = view.probe.face_mm;
    const Vector shaft = times(minus(hub, tip), 1.0 / far);
    const double y = tip[1], v = shaft[1];
    Crossings found;
    for (const ScanView::Line& line : view.lines) {
        const Vector off = minus(tip, line.origin);
        const double a = dot(off, line.across), b = dot(shaft, line.across);
        const double depth = dot(off, line.along), deeper = dot(shaft, line.along);
        double low = 0.0, high = far;
        bound(low, high, -deeper, depth - face);
        const double sigma = view.slice_mm(depth);
        const double curvature = std::pow(b / radius, 2) + std::pow(v / sigma, 2);
        const double nearest = -(a * b / (radius * radius) + y * v / (sigma * sigma)) / std::max(curvature, kLeastNeedle);
        const double q = std::min(std::max(nearest, low), std::max(low, high));
        const double spacing = view.spacing_mm(depth + deeper * q), wider = view.turn * deeper;
        const double half = std::max(radius * std::fabs(v), 0.5 * spacing), steep = 1.0 - std::fabs(b);
        const double inside = std::fabs(b) * std::min(nearest - low, high - nearest) + 0.5 * spacing * steep;
        const double room = half + 0.5 * steep * spacing - 0.5 * (1.0 + steep) * wider * q;
        const double widening = 0.5 * (1.0 + steep) * wider;
        double first_q = low, last_q = high;
        bound(first_q, last_q, b - widening, room - a);
        bound(first_q, last_q, -b - widening, room + a);
        first_q = std::min(first_q, q), last_q = std::max(last_q, q);
        const double middle = y + 0.5 * v * (first_q + last_q), reached = radius + 0.5 * std::fabs(v) * (last_q - first_q);
        const double fills = beam_share(-reached, reached, sigma);
        const double cover = covered(std::fabs(a + b * nearest), half, spacing) * covered(-inside, 0.0, spacing) *
                             (beam_share(middle - reached, middle + reached, sigma) / fills);
        const double reach = sigma / std::max(std::fabs(v), kLeastNeedle);
        first_q = std::max(first_q, q - reach), last_q = std::min(last_q, q + reach);
        const double one = depth + deeper * first_q, other = depth + deeper * last_q;
        const double first = std::min(one, other), last = std::max(one, other);
        const double path = std::min(needle.diameter_mm / std::sqrt(std::max(1.0 - deeper * deeper, kLeastNeedle)),
                                     far + needle.diameter_mm);
        // The shaft's own thickness along the line, but not beyond its ends.
        const double at = depth + deeper * q, slow = std::max(std::fabs(deeper), kLeastNeedle);
        const double to_tip = q / slow, to_hub = (far - q) / slow;
        const double above = deeper >= 0.0 ? to_tip : to_hub, below = deeper >= 0.0 ? to_hub : to_tip;
        found.push_back(
            {{low <= high ? cover : 0.0, first, last, 0.0, std::max(std::min(first, at - std::min(0.5 * path, above)), face),
              std::max(last, at + std::min(0.5 * path, below)), path, std::min(std::fabs(deeper), 1.0),
              stopped_by(needle, path) * fills}});
    }
    return found;
}

float beyond(float depth, float first, float last) { return std::max(std::max(first - depth, depth - last), 0.0f); }
float pulse(float distance, float log_strength = 0.0f) { return std::exp(log_strength - kByPulse * distance * distance); }

}  // namespace

ScanView::ScanView(const Probing& probe, const Pose& pose, int width, const std::optional<ElevationBeam>& beam)
    : probe(probe), pose_(pose) {
    const bool thick = beam && beam->thickness_mm > 0.0;
    sigma_mm_ = (thick ? beam->thickness_mm : kBeamMm) / kFwhmPerSigma;
    focus_mm_ = thick ? beam->focus_mm.value_or(0.0) + probe.face_mm : 0.0;
    rayleigh_mm_ = thick && beam->depth_of_field_mm ? *beam->depth_of_field_mm / 2.0 : kInfinity;
    for (int j = 0; j < width; ++j) {
        const auto [origin, along] = probe.ray(probe.across(j, width));
        lines.push_back({origin, along, {along[2], 0.0, -along[0]}});
    }
    const auto [origin, along] = probe.ray(probe.start() + probe.span * (0.5 - 0.5 / width));
    const Ray next = probe.ray(probe.start() + probe.span * (0.5 + 0.5 / width));
    turn = std::acos(std::clamp(dot(along, next.direction), -1.0, 1.0));
    apart_mm_ = std::fabs(cross(minus(next.origin, origin), along)[1]);
}

double ScanView::spacing_mm(double depth) const { return std::max(apart_mm_ + turn * depth, kLeastSpacingMm); }

double ScanView::slice_mm(double depth) const {
    return std::max(sigma_mm_ * std::hypot(1.0, (depth - focus_mm_) / rayleigh_mm_), kLeastSliceSigmaMm);
}

Vector ScanView::seen(ToolFrame frame, const Vector& point) const {
    return frame == ToolFrame::Scene ? pose_.turned_back(minus(point, pose_.origin)) : point;
}

namespace {

template <class Shape>
bool draw_tool(const Shape& tool, const ScanView& view, int height, DrawnTool& drawn) {
    const Crossings crossings = crossings_of(tool, view);
    drawn.first = -1;
    for (size_t j = 0; j < crossings.size(); ++j)
        for (const Crossing& one : crossings[j])
            if (one.cover >= kLeastSeen) {
                if (drawn.first < 0) drawn.first = int(j);
                drawn.last = int(j);
            }
    if (drawn.first < 0) return false;
    const int width = drawn.last - drawn.first + 1;
    for (auto* plane : {&drawn.own, &drawn.body, &drawn.echo, &drawn.passed, &drawn.tail})
        plane->assign(size_t(height) * width, 0.0f);
    drawn.label = int(tool.label);
    const float half_row = float(0.5 * view.probe.length_mm() / height), thickness = float(thickness_of(tool));
    const float rough = float(tool.brightness * tool.roughness), mirror = float(tool.brightness * (1.0 - tool.roughness));
    const float log_share = tool.reverberation > 0.0 ? float(std::log(tool.reverberation)) : 0.0f;
    for (int column = 0; column < width; ++column) {
        for (const Crossing& one : crossings[drawn.first + column]) {
            const float cover = float(one.cover), last = float(one.last_mm), path = float(one.path_mm);
            const float top = float(one.first_mm) - half_row, bottom = last + half_row;
            const float own_first = std::min(float(one.own_first_mm), top),
                        own_last = std::max(float(one.own_last_mm), bottom);
            const float angle = std::asin(float(one.slant)) * float(180.0 / kPi) / kHeadOnSigmaDeg;
            const float mirrored = mirror * std::exp(-0.5f * angle * angle), lost = std::log1p(-float(one.stopped));
            for (int row = 0; row < height; ++row) {
                const size_t at = size_t(row) * width + column;
                const float depth = float(view.probe.depth_mm(row, height));
                drawn.own[at] += beyond(depth, own_first, own_last) == 0.0f ? cover : 0.0f;
                drawn.body[at] += cover * pulse(beyond(depth, top, bottom + float(one.filled_mm)));
                drawn.echo[at] += cover * (rough + mirrored) * pulse(beyond(depth, top, bottom));
                drawn.passed[at] -= cover * std::expm1(lost * std::clamp((depth - last) / path, 0.0f, 1.0f));
                if (tool.reverberation == 0.0) continue;
                const float number = std::max(std::nearbyint((depth - 0.5f * (top + bottom)) / thickness), 1.0f);
                drawn.tail[at] +=
                    cover * mirrored * pulse(beyond(depth - number * thickness, top, bottom), number * log_share);
            }
        }
    }
    for (size_t at = 0; at < drawn.own.size(); ++at) {
        drawn.body[at] = std::min(drawn.body[at], 1.0f);
        drawn.echo[at] = std::min(drawn.echo[at], 1.0f);
        drawn.passed[at] = std::clamp(1.0f - drawn.passed[at], 0.0f, 1.0f);  // until here what it stops
        drawn.tail[at] = std::min(drawn.tail[at], 1.0f);
    }
    return true;
}

}  // namespace

ToolsInView::ToolsInView(const std::vector<Tool>& tools, const ScanView& view, int height)
    : height_(height), width_(int(view.lines.size())) {
    for (const Tool& tool : tools) {
        DrawnTool drawn;
        if (std::visit([&](const auto& one) { return draw_tool(one, view, height, drawn); }, tool))
            drawn_.push_back(std::move(drawn));
    }
}

// Of the beam T before it a share `passed` goes on through the tissue behind it, and of what is then heard a share `tail` is
// the tool once more: T' = T ((1 - tail) passed + tail), and E' is the mean of both echoes by their beams.
void ToolsInView::draw(Planes& planes) const {
    for (const DrawnTool& tool : drawn_) {
        const int width = tool.last - tool.first + 1;
        for (int row = 0; row < height_; ++row) {
            for (int column = 0; column < width; ++column) {
                const size_t at = size_t(row) * width + column, to = size_t(row) * width_ + tool.first + column;
                const float through = (1.0f - tool.tail[at]) * tool.passed[at], heard = through + tool.tail[at];
                if (!planes.bmode.empty()) {
                    const float beam = planes.transmittance[to];
                    const float surface = (1.0f - tool.body[at]) * planes.bmode[to] + tool.echo[at] * beam;
                    planes.bmode[to] = through * surface + tool.tail[at] * beam;
                }
                if (!planes.echo.empty()) {
                    const float surface = (1.0f - tool.body[at]) * planes.echo[to] + tool.echo[at];
                    planes.echo[to] = (through * surface + tool.tail[at]) / std::max(heard, kLeastBeam);
                }
                if (!planes.transmittance.empty()) planes.transmittance[to] *= heard;
                if (!planes.coverage.empty()) planes.coverage[to] = std::max(planes.coverage[to], tool.body[at]);
            }
        }
    }
}

void ToolsInView::mark(std::vector<float>& labels) const {
    for (const DrawnTool& tool : drawn_) {
        const int width = tool.last - tool.first + 1;
        for (int row = 0; row < height_; ++row)
            for (int column = 0; column < width; ++column)
                if (tool.own[size_t(row) * width + column] >= kLabelled)
                    labels[size_t(row) * width_ + tool.first + column] = float(tool.label);
    }
}

namespace {

constexpr float kStrongBmode = 0.6f, kLeastHeard = 1e-6f;
constexpr double kLeastDepthMm = 5.0, kSmoothedShare = 0.06;

// The row of the first strong interface of each line, the height where there is none: B-mode is averaged across lines, and
// rows are medians, as a surface runs on from line to line where speckle does not.
std::vector<int> interfaces(const std::vector<float>& bmode, const Probing& probe, int height, int width) {
    const int beside = int(std::nearbyint(width * kSmoothedShare / 2.0));
    const auto place = [&](int column) {
        return probe.wraps() ? (column % width + width) % width : std::clamp(column, 0, width - 1);
    };
    std::vector<int> first(width, height), found(width), window(2 * beside + 1);
    for (int column = 0; column < width; ++column) {
        for (int row = 0; row < height; ++row) {
            if (probe.depth_mm(row, height) - probe.face_mm < kLeastDepthMm) continue;
            float sum = 0;
            for (int k = column - beside; k <= column + beside; ++k) sum += bmode[size_t(row) * width + place(k)];
            if (sum / float(2 * beside + 1) < kStrongBmode) continue;
            first[column] = row;
            break;
        }
    }
    for (int column = 0; column < width; ++column) {
        for (int k = 0; k < 2 * beside + 1; ++k) window[k] = first[place(column - beside + k)];
        std::nth_element(window.begin(), window.begin() + beside, window.end());
        found[column] = window[beside];
    }
    return found;
}

}  // namespace

void add_ghosts(Planes& planes, const Probing& probe, int height, int width, double share) {
    const std::vector<int> interface = interfaces(planes.bmode, probe, height, width);
    const std::vector<float> bmode = planes.bmode, beam = planes.transmittance;
    const float mixed = float(share);
    for (int row = 0; row < height; ++row) {
        for (int column = 0; column < width; ++column) {
            const int mirrored = 2 * interface[column] - row;
            if (row <= interface[column] || mirrored < 0) continue;
            const size_t at = size_t(row) * width + column, from = size_t(mirrored) * width + column;
            planes.bmode[at] += mixed * (bmode[from] - bmode[at]);
            planes.transmittance[at] += mixed * (beam[from] - beam[at]);
            planes.echo[at] = planes.bmode[at] / std::max(planes.transmittance[at], kLeastHeard);
        }
    }
}

}  // namespace ultragray::library
