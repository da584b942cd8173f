// Vectors of kLanes floats by the compiler's vector extension; each instruction set compiles its own copy (see
// kernel_*.cpp). Everything here has internal linkage: code for a wider instruction set must never be shared with the
// others.
#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>
#if defined(__AVX2__)  // AVX-512 includes it
#include <immintrin.h>
#elif defined(__SSE__)
#include <xmmintrin.h>
#elif defined(__wasm_simd128__)
#include <wasm_simd128.h>
#endif

namespace {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float Floats __attribute__((vector_size(kLanes * sizeof(float))));
typedef int32_t Ints __attribute__((vector_size(kLanes * sizeof(int32_t))));
typedef double Doubles __attribute__((vector_size(kLanes * sizeof(double))));
typedef uint8_t Bytes __attribute__((vector_size(kLanes)));

inline Floats splat(float x) { return x - Floats{}; }
// Register by register: a vector that is longer than one, GCC 12 may fill by way of memory, number by number.
inline Doubles splat_double(double x) {
    typedef double Register __attribute__((vector_size(sizeof(Floats))));
    const Register half = x - Register{};
    Doubles whole;
    std::memcpy(&whole, &half, sizeof half);
    std::memcpy(reinterpret_cast<char*>(&whole) + sizeof half, &half, sizeof half);
    return whole;
}
template <class Reals>
inline Reals splat_any(double x) {
    if constexpr (std::is_same_v<Reals, Doubles>)
        return splat_double(x);
    else
        return splat(static_cast<float>(x));
}
template <class Reals>
inline Floats to_floats(Reals x) {
    return __builtin_convertvector(x, Floats);
}
template <class Vector>
using Lane = std::decay_t<decltype(Vector{}[0])>;

template <class Vector, class Scalar>
inline Vector load(const Scalar* p) {
    Vector v;
    std::memcpy(&v, p, sizeof v);
    return v;
}

template <class Vector, class Scalar>
inline void store(Scalar* p, Vector v) {
    std::memcpy(p, &v, sizeof v);
}

#if defined(__AVX512F__)
// Masks live in their own registers there; the vector extension would move them through vectors.
typedef __mmask16 Mask;
inline Mask less_equal(Floats a, Floats b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LE_OQ); }
inline Mask both(Mask a, Mask b) { return a & b; }
inline Mask either(Mask a, Mask b) { return a | b; }
inline bool any(Mask m) { return m != 0; }
inline int how_many(Mask m) { return __builtin_popcount(m); }
inline Floats select(Mask m, Floats a, Floats b) { return (Floats)_mm512_mask_blend_ps(m, (__m512)b, (__m512)a); }
inline Floats keep(Mask m, Floats a) { return (Floats)_mm512_maskz_mov_ps(m, (__m512)a); }
inline Mask within(Floats low, Floats x, Floats high) {
    return _mm512_mask_cmp_ps_mask(less_equal(low, x), (__m512)x, (__m512)high, _CMP_LE_OQ);
}
inline Floats keep_product(Mask m, Floats a, Floats b) { return (Floats)_mm512_maskz_mul_ps(m, (__m512)a, (__m512)b); }
// -most to most, most > 0.
inline Floats limited(Floats a, Floats most) { return (Floats)_mm512_range_ps((__m512)a, (__m512)most, 0b0010); }
inline Floats minimum(Floats a, Floats b) { return (Floats)_mm512_min_ps((__m512)a, (__m512)b); }
inline Floats maximum(Floats a, Floats b) { return (Floats)_mm512_max_ps((__m512)a, (__m512)b); }
inline Floats square_root(Floats a) { return (Floats)_mm512_sqrt_ps((__m512)a); }
inline float smallest(Floats a) { return _mm512_reduce_min_ps((__m512)a); }
inline float largest(Floats a) { return _mm512_reduce_max_ps((__m512)a); }
inline float total(Floats a) { return _mm512_reduce_add_ps((__m512)a); }
#else
typedef Ints Mask;
inline Mask less_equal(Floats a, Floats b) { return a <= b; }
inline Mask both(Mask a, Mask b) { return a & b; }
inline Mask either(Mask a, Mask b) { return a | b; }
inline bool any(Mask m) {
#if defined(__AVX2__)
    return _mm256_movemask_ps((__m256)m) != 0;
#elif defined(__wasm_simd128__)
    return wasm_v128_any_true((v128_t)m);
#else
    int32_t lanes[kLanes], found = 0;
    store(lanes, m);
    for (int k = 0; k < kLanes; ++k) found |= lanes[k];
    return found != 0;
#endif
}
inline int how_many(Mask m) {
#if defined(__AVX2__)
    return __builtin_popcount(_mm256_movemask_ps((__m256)m));
#elif defined(__wasm_simd128__)
    return __builtin_popcount(wasm_i32x4_bitmask((v128_t)m));
#else
    int found = 0;
    for (int k = 0; k < kLanes; ++k) found += m[k] != 0;
    return found;
#endif
}
inline Floats keep(Mask m, Floats a) { return (Floats)(m & (Ints)a); }
inline Mask within(Floats low, Floats x, Floats high) { return (low <= x) & (x <= high); }
inline Floats keep_product(Mask m, Floats a, Floats b) { return keep(m, a * b); }
#if defined(__AVX2__)
inline Floats select(Mask m, Floats a, Floats b) { return (Floats)_mm256_blendv_ps((__m256)b, (__m256)a, (__m256)m); }
inline Floats minimum(Floats a, Floats b) { return (Floats)_mm256_min_ps((__m256)a, (__m256)b); }
inline Floats maximum(Floats a, Floats b) { return (Floats)_mm256_max_ps((__m256)a, (__m256)b); }
inline Floats square_root(Floats a) { return (Floats)_mm256_sqrt_ps((__m256)a); }
// Combines all lanes, halves first.
template <class Operation>
inline float reduced(Floats a, Operation combine) {
    const __m128 four = combine(_mm256_castps256_ps128((__m256)a), _mm256_extractf128_ps((__m256)a, 1));
    const __m128 two = combine(four, _mm_movehl_ps(four, four));
    return _mm_cvtss_f32(combine(two, _mm_movehdup_ps(two)));
}
inline float smallest(Floats a) {
    return reduced(a, [](__m128 x, __m128 y) { return _mm_min_ps(x, y); });
}
inline float largest(Floats a) {
    return reduced(a, [](__m128 x, __m128 y) { return _mm_max_ps(x, y); });
}
inline float total(Floats a) {
    return reduced(a, [](__m128 x, __m128 y) { return _mm_add_ps(x, y); });
}
#else
inline Floats select(Mask m, Floats a, Floats b) { return (Floats)((m & (Ints)a) | (~m & (Ints)b)); }
#if defined(__wasm_simd128__)
inline Floats minimum(Floats a, Floats b) { return (Floats)wasm_f32x4_pmin((v128_t)b, (v128_t)a); }
inline Floats maximum(Floats a, Floats b) { return (Floats)wasm_f32x4_pmax((v128_t)b, (v128_t)a); }
inline Floats square_root(Floats a) { return (Floats)wasm_f32x4_sqrt((v128_t)a); }
#else
inline Floats minimum(Floats a, Floats b) { return select(less_equal(a, b), a, b); }
inline Floats maximum(Floats a, Floats b) { return select(less_equal(a, b), b, a); }
inline Floats square_root(Floats a) {
    for (int k = 0; k < kLanes; ++k) a[k] = __builtin_sqrtf(a[k]);
    return a;
}
#endif
inline float smallest(Floats a) {
    float found = a[0];
    for (int k = 1; k < kLanes; ++k) found = a[k] < found ? a[k] : found;
    return found;
}
inline float largest(Floats a) {
    float found = a[0];
    for (int k = 1; k < kLanes; ++k) found = a[k] > found ? a[k] : found;
    return found;
}
inline float total(Floats a) {
    float sum = 0;
    for (int k = 0; k < kLanes; ++k) sum += a[k];
    return sum;
}
#endif
#endif

// Whole numbers from 0 to 255: the nearest, of two the even one.
inline Bytes to_bytes(Floats x) {
#if defined(__AVX512F__)
    const Ints whole = (Ints)_mm512_cvtps_epi32((__m512)x);
#elif defined(__AVX2__)
    const Ints whole = (Ints)_mm256_cvtps_epi32((__m256)x);
#else
    Ints whole;
    for (int k = 0; k < kLanes; ++k) whole[k] = static_cast<int32_t>(__builtin_lrintf(x[k]));
#endif
    return __builtin_convertvector(whole, Bytes);
}

// exp(x) within 2 units in the last place for x in [-87, 88]; clamped outside: 1e-38 below, 1.6e38 above.
inline Floats exponential(Floats x) {
    x = minimum(maximum(x, splat(-87.0f)), splat(88.0f));
    const Floats shifted = x * 1.44269504089f + 12582912.0f;  // 1.5 * 2^23 rounds to an integer in the low bits
    const Floats n = shifted - 12582912.0f;
    const Floats r = (x - n * 0.693359375f) + n * 2.12194440e-4f;
    Floats p = splat(1.9875691500e-4f);
    p = p * r + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 5.0000001201e-1f;
    p = p * r * r + r + 1.0f;
    const Ints exponent = ((Ints)shifted << 23) + (127 << 23);  // the low bits of `shifted` hold n
    return p * (Floats)exponent;
}

// While it lives, numbers too small for a normal float are 0 on x86, where each of them costs many times a usual one: the
// weight of a slice falls to them within a few lines and rows of its window.
class [[maybe_unused]] SmallestAreZero {
#if defined(__SSE__)
 public:
    SmallestAreZero() : before_(_mm_getcsr()) { _mm_setcsr(before_ | 0x8040); }  // FTZ and DAZ
    ~SmallestAreZero() { _mm_setcsr(before_); }
    SmallestAreZero(const SmallestAreZero&) = delete;
    SmallestAreZero& operator=(const SmallestAreZero&) = delete;

 private:
    unsigned before_;
#endif
};

}  // namespace
