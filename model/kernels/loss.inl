// Half L1, half structural dissimilarity of one image, and the gradient: SSIM with a Gaussian window of 11x11 pixels,
// sigma 1.5, only where the window lies inside (docs/physics.md §7). Both passes are separable: down the columns, then along
// the rows.

#pragma once

namespace {

constexpr int kWindow = 11;
constexpr float kSsimC1 = 0.01f * 0.01f, kSsimC2 = 0.03f * 0.03f;

// kMaps rows blurred down the columns, then along the row: out[m] at `column` for maps of rows that start at `from`.
template <int kMaps>
inline void blur_along(const float* rows, int stride, int column, const float* window, Floats (&out)[kMaps]) {
    for (int m = 0; m < kMaps; ++m) {
        Floats sum{};
        for (int u = 0; u < kWindow; ++u) sum += window[u] * load<Floats>(rows + m * stride + column + u);
        out[m] = sum;
    }
}

// What the two passes share. Planes have rows of `stride` floats; `x` and `y` are padded with zeros to the right, the three
// maps of derivatives by a window on all sides.
struct LossScratch {
    float *x, *y, *by_mean, *by_square, *by_product, *rows;
    int stride;
};

inline double ssim_and_derivatives(const LossScratch& s, int height, int width, const float* window) {
    const int valid_width = width - kWindow + 1;
    double total = 0;
    for (int i = 0; i + kWindow <= height; ++i) {
        for (int j = 0; j < s.stride - kMaxLanes; j += kLanes) {
            Floats x1{}, y1{}, xx{}, yy{}, xy{};
            for (int t = 0; t < kWindow; ++t) {
                const int64_t at = int64_t(i + t) * s.stride + j;
                const Floats x = load<Floats>(s.x + at), y = load<Floats>(s.y + at), wx = window[t] * x, wy = window[t] * y;
                x1 += wx, y1 += wy, xx += wx * x, yy += wy * y, xy += wx * y;
            }
            const Floats maps[5] = {x1, y1, xx, yy, xy};
            for (int m = 0; m < 5; ++m) store(s.rows + m * s.stride + j, maps[m]);
        }
        Floats row_total{};
        for (int j = 0; j < valid_width; j += kLanes) {
            Floats m[5];
            blur_along(s.rows, s.stride, j, window, m);
            const Floats a1 = 2.0f * m[0] * m[1] + kSsimC1, a2 = 2.0f * (m[4] - m[0] * m[1]) + kSsimC2;
            const Floats b1 = m[0] * m[0] + m[1] * m[1] + kSsimC1;
            const Floats b2 = m[2] + m[3] - m[0] * m[0] - m[1] * m[1] + kSsimC2;
            const Floats inverse = 1.0f / (b1 * b2), inverse2 = b1 * inverse;
            const Floats similarity = a1 * a2 * inverse;
            const Floats by_square = -similarity * inverse2, by_product = 2.0f * a1 * inverse;
            const Floats by_mean = 2.0f * (m[1] * (a2 - a1) * inverse + m[0] * similarity * (inverse2 - b2 * inverse));
            Floats inside = splat(1.0f);
            if (j + kLanes > valid_width)
                for (int k = valid_width - j; k < kLanes; ++k) inside[k] = 0.0f;
            row_total += inside * similarity;
            const int64_t at = int64_t(i + kWindow - 1) * s.stride + j + kWindow - 1;
            store(s.by_mean + at, inside * by_mean);
            store(s.by_square + at, inside * by_square);
            store(s.by_product + at, inside * by_product);
        }
        for (int k = 0; k < kLanes; ++k) total += row_total[k];
    }
    return total;
}

ImageLoss image_loss(const float* x, const float* y, const float* weight, int height, int width, const float* window,
                     float* scratch, float by_l1, float by_ssim, float* gradient) {
    const int stride = loss_stride(width), rows = height + kWindow - 1;
    const int64_t plane = int64_t(rows) * stride;
    const LossScratch s{
        scratch, scratch + plane, scratch + 2 * plane, scratch + 3 * plane, scratch + 4 * plane, scratch + 5 * plane,
        stride};
    __builtin_memset(scratch, 0, loss_scratch(height, width) * sizeof(float));
    for (int i = 0; i < height; ++i) {
        const int64_t from = int64_t(i) * width, to = int64_t(i) * stride;
        __builtin_memcpy(s.y + to, y + from, width * sizeof(float));
        if (weight == nullptr)
            __builtin_memcpy(s.x + to, x + from, width * sizeof(float));
        else
            for (int j = 0; j < width; ++j) s.x[to + j] = y[from + j] + weight[from + j] * (x[from + j] - y[from + j]);
    }
    ImageLoss loss{0, ssim_and_derivatives(s, height, width, window)};
    for (int i = 0; i < height; ++i) {
        for (int j = 0; j < stride - kMaxLanes; j += kLanes) {
            Floats mean{}, square{}, product{};
            for (int t = 0; t < kWindow; ++t) {
                const int64_t at = int64_t(i + t) * stride + j;
                mean += window[t] * load<Floats>(s.by_mean + at);
                square += window[t] * load<Floats>(s.by_square + at);
                product += window[t] * load<Floats>(s.by_product + at);
            }
            const Floats maps[3] = {mean, square, product};
            for (int m = 0; m < 3; ++m) store(s.rows + m * stride + j, maps[m]);
        }
        Floats row_total{};
        for (int j = 0; j < width; j += kLanes) {
            Floats m[3];
            blur_along(s.rows, stride, j, window, m);
            const int64_t at = int64_t(i) * stride + j;
            const Floats value = load<Floats>(s.x + at), truth = load<Floats>(s.y + at), difference = value - truth;
            const Mask above = less_equal(truth, value), below = less_equal(value, truth);
            const Floats sign = keep(above, splat(1.0f)) - keep(below, splat(1.0f));
            row_total += maximum(difference, -difference);  // zero beyond the image
            const Floats out = by_l1 * sign + by_ssim * (m[0] + 2.0f * value * m[1] + truth * m[2]);
            float* to = gradient + int64_t(i) * width + j;
            if (j + kLanes <= width) {
                store(to, out);
            } else {
                for (int k = 0; j + k < width; ++k) to[k] = out[k];
            }
        }
        for (int k = 0; k < kLanes; ++k) loss.l1 += row_total[k];
        const int64_t at = int64_t(i) * width;
        for (int j = 0; weight != nullptr && j < width; ++j) gradient[at + j] *= weight[at + j];
    }
    return loss;
}

}  // namespace
