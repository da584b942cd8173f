// The Gaussians of a compressed scene file (.ugz), as ultragray.scene.compressed describes and writes them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

namespace ultragray::library {

// Raw parameters, one Gaussian after another, as a scene file has them; `terms` of spherical harmonics above degree 0.
struct Parameters {
    int64_t terms = 0;
    bool has_labels = false;
    std::vector<float> means, scales, quats, transmittances, sh0, shn;
    std::vector<uint8_t> labels;
};

// Appends the Gaussians of a part, at most so many, the same to the bit as Python does. Throws Fault.
void append_part(Parameters& gaussians, const unsigned char* part, size_t size, int64_t most, const std::string& name);

// Continues a CRC-32.
uint32_t checksum(const void* bytes, size_t size, uint32_t before = 0);

}  // namespace ultragray::library
