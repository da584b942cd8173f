#include "kernel.hpp"
#include "profile.hpp"
#include "simd.hpp"

using namespace ultragray;

#include "slice.inl"
#include "draw.inl"
#include "gather.inl"

namespace ultragray {

const Kernels& kernels_avx512() {
    static constexpr Kernels kernels{"avx512", slice_clusters, draw, finish, differentiate, gather};
    return kernels;
}

}  // namespace ultragray
