// Tools in the image, such as needles, and the second echo (ultragray.rendering.tools and .overlays).
#pragma once

#include <vector>

#include "geometry.hpp"

namespace ultragray::library {

// What the kernels draw of a pose, [H, W] each; empty: not drawn.
struct Planes {
    std::vector<float> bmode, echo, transmittance, coverage;
    std::array<std::vector<float>*, 4> all() { return {&bmode, &echo, &transmittance, &coverage}; }
};

// A scan line that meets a tool, or one layer of its slice.
struct Crossing {
    double cover;                      // share of the line's width that meets it, times the slice's; 0 to 1
    double first_mm, last_mm;          // depths between which the side that is met first lies
    double filled_mm;                  // length of the line behind it that shows the tool's inside, not tissue
    double own_first_mm, own_last_mm;  // depths between which pixels have the tool's label
    double path_mm;                    // length of the way through the tool, above 0
    double slant;                      // sine of the angle between the line and the normal of the side
    double stopped;                    // share of the beam that the tool stops
};

// The scan lines of a probe at a pose as tracked, and the slice that they see.
class ScanView {
 public:
    ScanView(const Probing& probe, const Pose& pose, int width, const std::optional<ElevationBeam>& beam);
    double spacing_mm(double depth) const;                    // of neighbouring lines, across them; above 0
    double slice_mm(double depth) const;                      // standard deviation of the slice along elevation
    Vector seen(ToolFrame frame, const Vector& point) const;  // in the probe's frame

    struct Line {
        Vector origin, along, across;
    };
    const Probing& probe;
    std::vector<Line> lines;
    double turn;  // the angle between neighbouring lines, radians

 private:
    const Pose& pose_;
    double apart_mm_, sigma_mm_, focus_mm_, rayleigh_mm_;
};

// What a tool is to the pixels of the columns that it touches.
struct DrawnTool {
    int label, first, last;  // columns
    // [H, last - first + 1] each: share of a pixel that is its body, by its label; of the tissue's echo that gives way to
    // it; the echo of its surface; share of the beam that it lets through; share of the beam before it that comes back
    // later.
    std::vector<float> own, body, echo, passed, tail;
};

// Tools before the scan lines of a view, in the order in which they are drawn.
class ToolsInView {
 public:
    ToolsInView(const std::vector<Tool>& tools, const ScanView& view, int height);
    // Draws them into planes; B-mode only beside transmittance.
    void draw(Planes& planes) const;
    // Puts their labels into labels [H, W]; that of the last one where they meet.
    void mark(std::vector<float>& labels) const;

 private:
    std::vector<DrawnTool> drawn_;
    int height_, width_;
};

// Of what is heard beyond the first strong interface of a line a share becomes the mirror image of what lies before it.
// Wants B-mode, echo and transmittance.
void add_ghosts(Planes& planes, const Probing& probe, int height, int width, double share);

}  // namespace ultragray::library
