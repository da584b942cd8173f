// G(u) of docs/physics.md §3, the three-point Gauss-Legendre rule over the unclipped window, and its derivative, as
// parabolas.
#pragma once

namespace ultragray {

struct ProfileTable {
    static constexpr int kSteps = 32;
    alignas(64) float parabola[3][kSteps];  // coefficients of 1, u, u² on [-3.4 + 0.2 k, -3.2 + 0.2 k]
};

extern const ProfileTable kProfile;
extern const ProfileTable kProfileSlope;  // to be taken as 0 for u > 3

}  // namespace ultragray
