#include "scene.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>

#include "threads.hpp"

namespace ultragray {
namespace {

constexpr float kMinScale = 1e-15f, kMaxScale = 1e15f;  // cm; keeps squares within float
constexpr float kReach = 3.3290429f * (1 + 1e-5f);  // sqrt(-2 log(1/255)): w < 1/255 beyond this many standard deviations

double quat_norm(const RawSplats& raw, int64_t i) {
    double squares = 0;
    for (int d = 0; d < 4; ++d) squares += double(raw.quats[4 * i + d]) * raw.quats[4 * i + d];
    return std::sqrt(squares);
}

Gaussian activate(const RawSplats& raw, int64_t i, double norm) {
    Gaussian g;
    float largest = 0;
    for (int d = 0; d < 4; ++d) g.quat[d] = static_cast<float>(raw.quats[4 * i + d] / norm);
    for (int d = 0; d < 3; ++d) {
        g.mean[d] = raw.means[3 * i + d];
        g.scale[d] = std::clamp(std::exp(raw.scales[3 * i + d]), kMinScale, kMaxScale);
        largest = std::max(largest, g.scale[d]);
    }
    g.absorb = 1.0f / (1.0f + std::exp(raw.transmittances[i]));
    g.reach = largest * kReach;
    return g;
}

// Interleaves the low 10 bits of three integers.
uint32_t interleave(const std::array<uint32_t, 3>& cell) {
    uint32_t key = 0;
    for (int bit = 0; bit < 10; ++bit)
        for (int d = 0; d < 3; ++d) key |= ((cell[d] >> bit) & 1u) << (3 * bit + d);
    return key;
}

// Position along a Morton curve, wide Gaussians apart from the rest: one of them would widen its whole cluster.
std::vector<uint64_t> curve_keys(const std::vector<Gaussian>& gaussians) {
    std::array<float, 3> low{}, high{};
    std::vector<float> reaches;
    for (size_t i = 0; i < gaussians.size(); ++i) {
        for (int d = 0; d < 3; ++d) {
            low[d] = i ? std::min(low[d], gaussians[i].mean[d]) : gaussians[i].mean[d];
            high[d] = i ? std::max(high[d], gaussians[i].mean[d]) : gaussians[i].mean[d];
        }
        reaches.push_back(gaussians[i].reach);
    }
    std::nth_element(reaches.begin(), reaches.begin() + reaches.size() / 2, reaches.end());
    const float typical = reaches[reaches.size() / 2];
    std::vector<uint64_t> keys;
    for (const Gaussian& g : gaussians) {
        std::array<uint32_t, 3> cell;
        for (int d = 0; d < 3; ++d) {
            const float extent = high[d] - low[d];
            cell[d] = extent > 0 ? static_cast<uint32_t>(1023.0f * ((g.mean[d] - low[d]) / extent)) : 0;
        }
        const float octaves = std::log2(g.reach / typical);
        const uint64_t size_class = octaves > 1.0f ? static_cast<uint64_t>(std::min(octaves, 30.0f)) : 0;
        keys.push_back(size_class << 32 | interleave(cell));
    }
    return keys;
}

Cluster enclose(const Gaussian* gaussians, int64_t count) {
    Cluster cluster{};
    for (int d = 0; d < 3; ++d) {
        float low = gaussians[0].mean[d], high = low;
        for (int64_t i = 1; i < count; ++i) {
            low = std::min(low, gaussians[i].mean[d]);
            high = std::max(high, gaussians[i].mean[d]);
        }
        cluster.centre[d] = 0.5f * (low + high);
        cluster.half[d] = 0.5f * (high - low) * (1 + 1e-5f);
    }
    for (int64_t i = 0; i < count; ++i) cluster.reach = std::max(cluster.reach, gaussians[i].reach);
    return cluster;
}

}  // namespace

PreparedScene::PreparedScene(const RawSplats& raw, Order order, int threads)
    : order_(order), sh_degree_(raw.sh_degree), intensity_(raw.intensity), weighted_(raw.weighted) {
    if (raw.count == 0) return;
    gaussians_.resize(raw.count);
    quat_norms_.resize(order == Order::AsGiven ? raw.count : 0);
    run_ranges(
        raw.count,
        [&](int64_t begin, int64_t end) {
            for (int64_t i = begin; i < end; ++i) {
                const double norm = quat_norm(raw, i);
                gaussians_[i] = activate(raw, i, norm);
                if (order == Order::AsGiven) quat_norms_[i] = static_cast<float>(norm);
            }
        },
        threads);
    std::vector<int64_t> places(raw.count);
    std::iota(places.begin(), places.end(), 0);
    if (order == Order::Sorted) {
        const std::vector<Gaussian> given = gaussians_;
        const std::vector<uint64_t> keys = curve_keys(given);
        std::stable_sort(places.begin(), places.end(), [&](int64_t a, int64_t b) { return keys[a] < keys[b]; });
        for (int64_t i = 0; i < raw.count; ++i) gaussians_[i] = given[places[i]];
    }

    const int64_t terms = (sh_degree_ + 1) * (sh_degree_ + 1);
    sh_.resize(raw.count * terms);
    clusters_.resize((raw.count + kClusterSize - 1) / kClusterSize);
    run_ranges(
        static_cast<int64_t>(clusters_.size()),
        [&](int64_t begin, int64_t end) {
            for (int64_t cluster = begin; cluster < end; ++cluster) {
                const int64_t first = cluster * kClusterSize, last = std::min(first + kClusterSize, raw.count);
                for (int64_t i = first; i < last; ++i) {
                    sh_[i * terms] = raw.sh0[places[i]];
                    std::copy_n(raw.shn + places[i] * (terms - 1), terms - 1, &sh_[i * terms + 1]);
                }
                clusters_[cluster] = enclose(&gaussians_[first], last - first);
            }
        },
        threads);
}

void PreparedScene::to_raw(const GaussianGradient* gaussians, const float* sh, const RawGradients& out, int threads) const {
    const int64_t terms = (sh_degree_ + 1) * (sh_degree_ + 1);
    run_ranges(
        static_cast<int64_t>(gaussians_.size()),
        [&](int64_t begin, int64_t end) {
            for (int64_t i = begin; i < end; ++i) {
                const GaussianGradient& by = gaussians[i];
                const Gaussian& g = gaussians_[i];
                float along = 0;
                for (int d = 0; d < 4; ++d) along += by.quat[d] * g.quat[d];
                for (int d = 0; d < 4; ++d) out.quats[4 * i + d] = (by.quat[d] - along * g.quat[d]) / quat_norms_[i];
                for (int d = 0; d < 3; ++d) {
                    out.means[3 * i + d] = by.mean[d];
                    out.scales[3 * i + d] = by.log_scale[d];
                }
                out.transmittances[i] = weighted_ ? by.absorb * g.absorb : -by.absorb * g.absorb * (1.0f - g.absorb);
                out.sh0[i] = sh[i * terms];
                std::copy_n(sh + i * terms + 1, terms - 1, out.shn + i * (terms - 1));
            }
        },
        threads);
}

SceneView PreparedScene::view() const {
    return {gaussians_.data(),
            sh_.data(),
            clusters_.data(),
            static_cast<int64_t>(gaussians_.size()),
            static_cast<int64_t>(clusters_.size()),
            sh_degree_,
            intensity_,
            weighted_};
}

int64_t PreparedScene::bytes() const {
    return gaussians_.capacity() * sizeof(Gaussian) + (sh_.capacity() + quat_norms_.capacity()) * sizeof(float) +
           clusters_.capacity() * sizeof(Cluster);
}

}  // namespace ultragray
