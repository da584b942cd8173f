// Distances of points to the images of training views, a vector of views at a time.

#pragma once

namespace {

// Points [count, 3] of one pose, whose frame is turned from those of the views by `angles` [P] degrees, and whose elevation
// axis has the cosine `facing` [P] with theirs.
void measure_views(const float* points, int count, const float* angles, const float* facing, const ViewImages& views,
                   const ViewLimits& limits, const ViewDistances& found) {
    const int64_t n = views.count;
    const float middle = 0.5f * (views.near + views.far), reach = 0.5f * (views.far - views.near);
    const Floats nothing = splat(0.0f), most = splat(limits.most);
    const auto size = [](Floats a) { return maximum(a, -a); };
    for (int64_t v = 0; v < n; ++v) found.around[v] = 0;
    for (int k = 0; k < count; ++k) {
        const float* p = points + 3 * k;
        Floats least = splat(__builtin_inff()), nearest = nothing, front = most, back = most;
        Ints best{};
        for (int64_t v = 0; v < n; v += kLanes) {
            const auto coordinate = [&](int axis) {
                const float* of = views.axes + 3 * axis * n + v;
                return p[0] * load<Floats>(of) + p[1] * load<Floats>(of + n) + p[2] * load<Floats>(of + 2 * n) -
                       load<Floats>(views.offsets + axis * n + v);
            };
            const Floats x = coordinate(0), y = coordinate(1), z = coordinate(2);
            const Floats depth = views.fanned ? square_root(x * x + z * z) : z * views.by_z;
            const Floats lateral = maximum(views.scale * size(x - views.slope * z) - views.across * z - views.half, nothing);
            const Floats axial = maximum(size(depth - middle) - reach, nothing);
            const Floats distance = square_root(y * y + lateral * lateral + axial * axial);
            const Floats judged = distance + limits.by_degree * load<Floats>(angles + v);
            const Mask farther = less_equal(least, judged);
            least = select(farther, least, judged), nearest = select(farther, nearest, distance);
            best = (Ints)select(farther, (Floats)best, (Floats)(Ints{} + int32_t(v)));
            const Floats clipped = minimum(maximum(distance, splat(limits.least)), most);
            store(found.around + v, load<Floats>(found.around + v) + clipped * clipped);
            const Mask before = less_equal(nothing, y * load<Floats>(facing + v));
            front = select(before, minimum(front, clipped), front), back = select(before, back, minimum(back, clipped));
        }
        int lane = 0;
        for (int k = 1; k < kLanes; ++k)
            if (least[k] < least[lane] || (least[k] == least[lane] && best[k] + k < best[lane] + lane)) lane = k;
        found.nearest[k] = nearest[lane], found.place[k] = best[lane] + lane;
        found.before[k] = smallest(front), found.behind[k] = smallest(back);
    }
    for (int64_t v = 0; v < n; ++v) found.around[v] = __builtin_sqrtf(found.around[v] / float(count));
}

}  // namespace
