// What fields of the contract mean together: what their own limits cannot say.
#include <cmath>

#include "contract.hpp"

namespace ultragray::library {
namespace {

void check_depths(double near_mm, double far_mm, const Value& value) {
    if (far_mm <= near_mm)
        value.fail("far_mm", "must be greater than near_mm (" + in_words(near_mm) + "), got " + in_words(far_mm));
}

template <class Shaft>
void check_shaft(const Shaft& it, const Value& value) {
    if (it.tip_mm == it.hub_mm) value.fail("hub_mm", "must differ from tip_mm: they say where it points");
}

void check_between(const char* name, const std::vector<double>& between, const Value& value) {
    if (!between.empty() && (between.size() != 2 || between[0] > between[1]))
        value.fail(name, "must be two numbers, the lower one first");
}

void check_count(const char* name, size_t count, size_t expected, const Value& value) {
    if (count != expected)
        value.fail(name, "must be " + std::to_string(expected) + " numbers, got " + std::to_string(count));
}

}  // namespace

void check(const ElevationBeam& it, const Value& value) {
    if (it.focus_mm.has_value() != it.depth_of_field_mm.has_value())
        value.fail(it.focus_mm ? "depth_of_field_mm" : "focus_mm",
                   "must be given: a beam has a focus and a depth of field, or neither");
}
void check(const ConvexProbe& it, const Value& value) { check_depths(it.near_mm, it.far_mm, value); }
void check(const LinearProbe& it, const Value& value) { check_depths(it.near_mm, it.far_mm, value); }
void check(const PhasedProbe& it, const Value& value) { check_depths(it.near_mm, it.far_mm, value); }
void check(const RadialProbe& it, const Value& value) { check_depths(it.near_mm, it.far_mm, value); }
void check(const SteeredProbe& it, const Value& value) { check_depths(it.near_mm, it.far_mm, value); }

void check(const Display& it, const Value& value) {
    check_between("gain_db_between", it.gain_db_between, value);
    check_between("dynamic_range_db_between", it.dynamic_range_db_between, value);
}

void check(const Box& it, const Value& value) {
    const auto& q = it.quaternion;
    const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    if (std::fabs(norm - 1.0) > 1e-3) value.fail("quaternion", "must have norm 1 within 0.001, got norm " + in_words(norm));
}
void check(const Cylinder& it, const Value& value) { check_shaft(it, value); }
void check(const Needle& it, const Value& value) { check_shaft(it, value); }

void check(const SpeckleModel& it, const Value& value) {
    constexpr size_t kBands = 4, kLevels = 9;
    check_count("axial_mm", it.axial_mm.size(), kBands, value);
    check_count("lateral_mm", it.lateral_mm.size(), kBands, value);
    check_count("elevation_mm", it.elevation_mm.size(), kBands, value);
    check_count("strength", it.strength.size(), kLevels, value);
}

void check(const Breathing&, const Value&) {}

void check(const RenderSettings& it, const Value& value) {
    for (const auto& [name, given] : {std::pair("phase", it.phase && !it.phase->empty()), {"breathing", bool(it.breathing)}})
        if (given) value.fail(name, "must not be given: frames without a service show tissue at rest");
    if (it.outputs.empty()) value.fail("outputs", "must name at least one");
    if (it.indentation_mm && it.contact != Contact::Pressure) value.fail("indentation_mm", "needs contact pressure");
}

}  // namespace ultragray::library
