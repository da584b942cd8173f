// Tissue that a probe's face presses in: layers of elastic tissue under a rigid punch. Lengths are mm, in the sweep's frame.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <vector>

namespace ultragray {

// How far tissue gives way under a stress: 1 / Young's modulus, per kPa, in cells of the scene; 0 is bone, which stays.
class Compliance {
 public:
    // `by_label` [256]; without labels (null) all tissue is that of label 0. Cells without a Gaussian have what those
    // beside them have, or what label 0 has.
    Compliance(const float* means_mm, const uint8_t* labels, int64_t count, const float* by_label);
    float at(const double* point_mm) const;

 private:
    float plain_;
    double low_[3] = {}, per_mm_ = 0;  // of the middle of the first cell; cells per mm
    int size_[3] = {};
    std::vector<float> cells_;
};

// The face of a probe, mm: where it lies on the axis of the probe, and how wide it is along its arc. Curved about the
// probe's origin, or flat.
struct Face {
    double depth, breadth;
    bool curved;
    double far;         // depth at which the image ends
    double half_width;  // of the image, where it is widest
};

// A displacement of tissue as splines (ultragray.scene.deformation), and the force of the face.
struct Pressed {
    std::vector<float> coefficients;  // [X, Y, Z, 3] mm along the scene's axes
    std::array<int, 3> size;
    std::array<double, 12> to_grid;  // [3, 4] grid coordinates of x, y, z, 1
    double force_n;
};

// A shaft in the tissue, in the probe's frame.
struct Shaft {
    double tip_mm[3], hub_mm[3];
};

// What a face does to the tissue of one scene.
class Press {
 public:
    // The layers are those under the face at some poses [count, 4, 4]; none: all is as at no label.
    Press(std::shared_ptr<const Compliance> compliance, const Face& face, const double* poses, int count);

    // With the face at a pose [4, 4], pressed in by so much at places evenly along its breadth.
    Pressed at(const double* pose, const double* indentation_mm, int places, const std::vector<Shaft>& needles) const;

    std::array<int, 3> size() const { return {(face_.curved ? kWide : columns_) + 2, kRows + 2, depths_ + 2}; }  // of fields

    static constexpr double kPoisson = 0.49;  // of all tissue

 private:
    struct Columns {
        std::vector<float> gives;  // [columns, rows, cells] over what the layer does
        std::vector<int> free;     // [columns, rows] cells before the first bone
    };
    void respond();
    Columns columns_of(const double* pose, const std::vector<double>& indentation) const;
    std::vector<double> load_of(const Columns& columns, const std::vector<double>& indentation) const;
    std::vector<float> moved_by(const Columns& columns, const std::vector<double>& load) const;
    Pressed on_grid(const double* pose, const std::vector<float>& moved, const std::vector<double>& indentation,
                    const std::vector<Shaft>& needles) const;
    void drag(const double* pose, const Shaft& needle, const double* point, double* moved) const;
    std::array<double, 3> place(double along, double depth, double indentation) const;  // in the probe's frame
    const float* response(int offset, int row) const {
        return &responses_[(size_t(offset) * (kRows / 2 + 1) + row) * 3 * depths_];
    }
    int cells() const { return depths_ - 1; }
    int margin() const { return (columns_ - strips_) / 2; }
    double along(int column) const { return (column - 0.5 * (columns_ - 1)) * pitch_; }

    static constexpr int kRows = 9;   // along elevation, odd
    static constexpr int kWide = 32;  // columns of a field under a curved face

    std::shared_ptr<const Compliance> compliance_;
    Face face_;
    int strips_, columns_, depths_;  // of the face; with what is beside it; into the tissue
    double pitch_, step_;            // between columns, and between depths
    std::vector<float> layers_;      // [cells] compliance of the mean of the tissue
    std::vector<float> responses_;   // [columns, rows / 2 + 1, 3, depths] along the arc, elevation and depth, mm / mN
};

}  // namespace ultragray
