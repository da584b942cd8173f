// G(u) of docs/physics.md §3, the three-point Gauss-Legendre rule over the unclipped window, and its derivative, as
// parabolas.
#pragma once

namespace ultragray {

struct ProfileTable {
    static constexpr int kSteps = 32;
    static constexpr float kMiddle = -0.2f;  // of the steps: v = u - kMiddle goes from -3.2 to 3.2
    alignas(
        64) float parabola[3][kSteps];  // coefficients of 1, v, v² on [0.2 n, 0.2 n + 0.2], n from -16 on, at n mod kSteps
};

extern const ProfileTable kProfile;
extern const ProfileTable kProfileSlope;  // to be taken as 0 for u > 3

}  // namespace ultragray
