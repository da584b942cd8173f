#include "kernel.hpp"
#include "profile.hpp"
#include "simd.hpp"

using namespace ultragray;

#include "slice.inl"
#include "draw.inl"
#include "gather.inl"

namespace ultragray {

const Kernels& kernels_baseline() {
    static constexpr Kernels kernels{"baseline", slice_clusters, draw, finish, differentiate, gather};
    return kernels;
}

}  // namespace ultragray
