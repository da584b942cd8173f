#include "random.hpp"

#include <cstring>

namespace ultragray::library {
namespace {

uint32_t rotated(uint32_t x, int bits) { return x >> bits | x << (32 - bits); }

// The first bits after the point of a root, of the primes from 2 on, as FIPS 180-4 takes them for its constants.
template <size_t N>
std::array<uint32_t, N> roots_of_primes(double (*root)(double)) {
    std::array<uint32_t, N> found{};
    size_t count = 0;
    for (int number = 2; count < N; ++number) {
        bool prime = true;
        for (int divisor = 2; divisor * divisor <= number; ++divisor) prime = prime && number % divisor;
        if (!prime) continue;
        const double value = root(number);
        found[count++] = uint32_t((value - std::floor(value)) * 4294967296.0);
    }
    return found;
}

// SHA-256 (FIPS 180-4).
std::array<uint8_t, 32> sha256(std::vector<uint8_t> message) {
    static const auto kBegin = roots_of_primes<8>([](double x) { return std::sqrt(x); });
    static const auto kRounds = roots_of_primes<64>([](double x) { return std::cbrt(x); });
    const uint64_t bits = 8 * message.size();
    message.push_back(0x80);
    while (message.size() % 64 != 56) message.push_back(0);
    for (int byte = 7; byte >= 0; --byte) message.push_back(uint8_t(bits >> (8 * byte)));
    std::array<uint32_t, 8> hash = kBegin;
    for (size_t at = 0; at < message.size(); at += 64) {
        uint32_t w[64];
        for (int t = 0; t < 64; ++t) {
            if (t < 16) {
                const uint8_t* m = &message[at + 4 * t];
                w[t] = uint32_t(m[0]) << 24 | uint32_t(m[1]) << 16 | uint32_t(m[2]) << 8 | m[3];
                continue;
            }
            const uint32_t a = w[t - 15], b = w[t - 2];
            w[t] = w[t - 16] + (rotated(a, 7) ^ rotated(a, 18) ^ a >> 3) + w[t - 7] +
                   (rotated(b, 17) ^ rotated(b, 19) ^ b >> 10);
        }
        auto [a, b, c, d, e, f, g, h] = hash;
        for (int t = 0; t < 64; ++t) {
            const uint32_t one =
                h + (rotated(e, 6) ^ rotated(e, 11) ^ rotated(e, 25)) + ((e & f) ^ (~e & g)) + kRounds[t] + w[t];
            const uint32_t two = (rotated(a, 2) ^ rotated(a, 13) ^ rotated(a, 22)) + ((a & b) ^ (a & c) ^ (b & c));
            h = g, g = f, f = e, e = d + one, d = c, c = b, b = a, a = one + two;
        }
        const uint32_t sums[8] = {a, b, c, d, e, f, g, h};
        for (int k = 0; k < 8; ++k) hash[k] += sums[k];
    }
    std::array<uint8_t, 32> digest;
    for (int k = 0; k < 32; ++k) digest[k] = uint8_t(hash[k / 4] >> (24 - 8 * (k % 4)));
    return digest;
}

// numpy.random.default_rng of numbers: a SeedSequence (M. O'Neill's seed_seq_fe) and the generator PCG64 (XSL-RR).
class Generator {
 public:
    explicit Generator(const std::array<uint8_t, 32>& seed) {
        uint32_t pool[4], factor = 0x43b0d7e5;
        const auto hashed = [&](uint32_t value) {
            value ^= factor, factor *= 0x931e8875, value *= factor;
            return value ^ value >> 16;
        };
        const auto mix = [](uint32_t& into, uint32_t value) {
            const uint32_t both = into * 0xca01f9dd - value * 0x4973f715;
            into = both ^ both >> 16;
        };
        for (int k = 0; k < 4; ++k) pool[k] = hashed(seed[k]);
        for (int from = 0; from < 4; ++from)
            for (int to = 0; to < 4; ++to)
                if (from != to) mix(pool[to], hashed(pool[from]));
        for (size_t from = 4; from < seed.size(); ++from)
            for (uint32_t& to : pool) mix(to, hashed(seed[from]));
        uint64_t words[4] = {};
        factor = 0x8b51f9dd;
        for (int k = 0; k < 8; ++k) {
            uint32_t word = pool[k % 4] ^ factor;
            factor *= 0x58f38ded, word *= factor;
            words[k / 2] |= uint64_t(word ^ word >> 16) << (32 * (k % 2));
        }
        step_ = (Wide(words[2]) << 64 | words[3]) << 1 | 1;
        advance();
        state_ += Wide(words[0]) << 64 | words[1];
        advance();
    }
    // The next number from 0 to 1, of 53 bits.
    double next() {
        advance();
        const uint64_t folded = uint64_t(state_ >> 64) ^ uint64_t(state_);
        const int turn = int(state_ >> 122);
        return double((folded >> turn | folded << (-turn & 63)) >> 11) / 9007199254740992.0;
    }

 private:
    using Wide = unsigned __int128;
    void advance() { state_ = state_ * (Wide(0x2360ed051fc65da4) << 64 | 0x4385df649fccf645) + step_; }
    Wide state_ = 0, step_;
};

}  // namespace

std::array<double, 2> drawn_shares(uint64_t seed, const Pose& pose) {
    std::vector<uint8_t> message;
    const auto append = [&](uint64_t bits) {
        for (int byte = 0; byte < 8; ++byte) message.push_back(uint8_t(bits >> (8 * byte)));
    };
    const auto append_number = [&](double number) {
        const double without_minus_0 = number + 0.0;
        uint64_t bits;
        std::memcpy(&bits, &without_minus_0, sizeof bits);
        append(bits);
    };
    append(seed);
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) append_number(pose.turn[i][j]);
        append_number(pose.origin[i]);
    }
    for (const double one : {0.0, 0.0, 0.0, 1.0}) append_number(one);
    Generator generator(sha256(message));
    const double first = generator.next();
    return {first, generator.next()};
}

}  // namespace ultragray::library
