// G(u) of docs/physics.md §3, the three-point Gauss-Legendre rule over the unclipped window, and its derivative, from -3.4
// to 3, piece by piece as polynomials in v = u - kMiddle.
#pragma once

namespace ultragray {

// As many pieces as an instruction set looks up within registers; u = 0, where the derivative has a kink, lies between two.
struct FineProfile {
    static constexpr int kPieces = 32, kTerms = 3;
    static constexpr float kWidth = 0.2f, kMiddle = -0.2f;
    alignas(64) float term[kTerms][kPieces];  // coefficients of 1, v, v²; the piece from n kWidth on at n mod kPieces
};
struct CoarseProfile {
    static constexpr int kPieces = 8, kTerms = 5;
    static constexpr float kWidth = 0.85f, kMiddle = 0.0f;
    alignas(64) float term[kTerms][kPieces];
};

extern const FineProfile kFineProfile;
extern const FineProfile kFineProfileSlope;  // to be taken as 0 for u > 3
extern const CoarseProfile kCoarseProfile;
extern const CoarseProfile kCoarseProfileSlope;  // likewise

}  // namespace ultragray
