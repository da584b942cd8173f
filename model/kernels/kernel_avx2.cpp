#include "kernel.hpp"
#include "profile.hpp"
#include "simd.hpp"

using namespace ultragray;

#include "adam.inl"
#include "draw.inl"
#include "gather.inl"
#include "loss.inl"
#include "slice.inl"
#include "speckle.inl"
#include "views.inl"

namespace ultragray {

const Kernels& kernels_avx2() {
    static constexpr Kernels kernels{"avx2", slice_clusters, draw,    count_work, finish,       differentiate,
                                     gather, image_loss,     speckle, adam,       measure_views};
    return kernels;
}

}  // namespace ultragray
