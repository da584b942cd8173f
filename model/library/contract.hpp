// Written by generate.py from the contract's dataclasses: `make generate` writes it anew.
// clang-format off
#pragma once

#include <variant>

#include "document.hpp"

namespace ultragray::library {

struct ElevationBeam {
    static constexpr const char* title = "ElevationBeam";
    double thickness_mm{};
    std::optional<double> focus_mm;
    std::optional<double> depth_of_field_mm;
    void read(Fields& fields) {
        fields.require("thickness_mm", [&](const Value& value) { thickness_mm = value.number({0.0, 100.0, {}}); });
        fields.read("focus_mm", [&](const Value& value) { focus_mm = value.number({0.0, 10000.0, {}}); });
        fields.read("depth_of_field_mm", [&](const Value& value) { depth_of_field_mm = value.number({0.1, 10000.0, {}}); });
    }
};
void check(const ElevationBeam& it, const Value& value);

struct ConvexProbe {
    static constexpr const char* title = "the probe convex";
    double opening_angle_deg{};
    double near_mm{};
    double far_mm{};
    void read(Fields& fields) {
        fields.require("opening_angle_deg", [&](const Value& value) { opening_angle_deg = value.number({{}, 175.0, 0.0}); });
        fields.require("near_mm", [&](const Value& value) { near_mm = value.number({0.0, 10000.0, {}}); });
        fields.require("far_mm", [&](const Value& value) { far_mm = value.number({{}, 10000.0, 0.0}); });
    }
};
void check(const ConvexProbe& it, const Value& value);

struct LinearProbe {
    static constexpr const char* title = "the probe linear";
    static constexpr double face_depth_mm = 0.0;
    double width_mm{};
    double near_mm{};
    double far_mm{};
    void read(Fields& fields) {
        fields.require("width_mm", [&](const Value& value) { width_mm = value.number({{}, 10000.0, 0.0}); });
        fields.require("near_mm", [&](const Value& value) { near_mm = value.number({0.0, 10000.0, {}}); });
        fields.require("far_mm", [&](const Value& value) { far_mm = value.number({{}, 10000.0, 0.0}); });
    }
};
void check(const LinearProbe& it, const Value& value);

struct PhasedProbe {
    static constexpr const char* title = "the probe phased";
    static constexpr double near_mm = 0.0;
    double opening_angle_deg{};
    double far_mm{};
    void read(Fields& fields) {
        fields.require("opening_angle_deg", [&](const Value& value) { opening_angle_deg = value.number({{}, 175.0, 0.0}); });
        fields.require("far_mm", [&](const Value& value) { far_mm = value.number({{}, 10000.0, 0.0}); });
    }
};
void check(const PhasedProbe& it, const Value& value);

struct RadialProbe {
    static constexpr const char* title = "the probe radial";
    double near_mm{};
    double far_mm{};
    void read(Fields& fields) {
        fields.require("near_mm", [&](const Value& value) { near_mm = value.number({0.0, 10000.0, {}}); });
        fields.require("far_mm", [&](const Value& value) { far_mm = value.number({{}, 10000.0, 0.0}); });
    }
};
void check(const RadialProbe& it, const Value& value);

struct SteeredProbe {
    static constexpr const char* title = "the probe steered";
    static constexpr double face_depth_mm = 0.0;
    double width_mm{};
    double steering_deg{};
    double near_mm{};
    double far_mm{};
    void read(Fields& fields) {
        fields.require("width_mm", [&](const Value& value) { width_mm = value.number({{}, 10000.0, 0.0}); });
        fields.require("steering_deg", [&](const Value& value) { steering_deg = value.number({-45.0, 45.0, {}}); });
        fields.require("near_mm", [&](const Value& value) { near_mm = value.number({0.0, 10000.0, {}}); });
        fields.require("far_mm", [&](const Value& value) { far_mm = value.number({{}, 10000.0, 0.0}); });
    }
};
void check(const SteeredProbe& it, const Value& value);

using Probe = std::variant<ConvexProbe, LinearProbe, PhasedProbe, RadialProbe, SteeredProbe>;
inline Probe read_Probe(const Value& value) {
    if (value.json() == "C5-2") return ConvexProbe{70.0, 50.0, 200.0};
    if (value.json() == "C9-4") return ConvexProbe{130.0, 11.0, 91.0};
    if (value.json() == "L7-4") return LinearProbe{38.0, 0.0, 80.0};
    if (value.json() == "L12-4") return LinearProbe{38.0, 0.0, 60.0};
    if (value.json() == "L15-7") return LinearProbe{25.0, 0.0, 40.0};
    if (value.json() == "P4-2") return PhasedProbe{90.0, 160.0};
    if (!value.json().is_object() || !value.json().contains("kind"))
        value.refuse("an object with a kind, one of convex, linear, phased, radial, steered");
    switch (value.at("kind").word({"convex", "linear", "phased", "radial", "steered"})) {
        case 0: return read_object<ConvexProbe>(value);
        case 1: return read_object<LinearProbe>(value);
        case 2: return read_object<PhasedProbe>(value);
        case 3: return read_object<RadialProbe>(value);
        default: return read_object<SteeredProbe>(value);
    }
}

struct Display {
    static constexpr const char* title = "Display";
    double gain_db = 0.0;
    double dynamic_range_db = 60.0;
    std::vector<double> tgc_db;
    std::optional<double> depth_mm;
    bool flip = false;
    std::optional<double> pixel_mm;
    double edge = 0.0;
    std::vector<double> gain_db_between;
    std::vector<double> dynamic_range_db_between;
    int64_t display_seed = 0;
    void read(Fields& fields) {
        fields.read("gain_db", [&](const Value& value) { gain_db = value.number({-100.0, 100.0, {}}); });
        fields.read("dynamic_range_db", [&](const Value& value) { dynamic_range_db = value.number({1.0, 200.0, {}}); });
        fields.read("tgc_db", [&](const Value& value) { tgc_db = value.numbers({-100.0, 100.0, {}}, 16); });
        fields.read("depth_mm", [&](const Value& value) { depth_mm = value.number({0.001, 10000.0, {}}); });
        fields.read("flip", [&](const Value& value) { flip = value.flag(); });
        fields.read("pixel_mm", [&](const Value& value) { pixel_mm = value.number({0.001, 100.0, {}}); });
        fields.read("edge", [&](const Value& value) { edge = value.number({0.0, 4.0, {}}); });
        fields.read("gain_db_between", [&](const Value& value) { gain_db_between = value.numbers({-100.0, 100.0, {}}, 2); });
        fields.read("dynamic_range_db_between", [&](const Value& value) { dynamic_range_db_between = value.numbers({1.0, 200.0, {}}, 2); });
        fields.read("display_seed", [&](const Value& value) { display_seed = value.integer({0.0, 9007199254740992.0, {}}); });
    }
};
void check(const Display& it, const Value& value);

enum class ToolFrame { Scene, Probe };
inline ToolFrame read_ToolFrame(const Value& value) { return static_cast<ToolFrame>(value.word({"scene", "probe"})); }

struct Box {
    static constexpr const char* title = "the tool box";
    ToolFrame frame = ToolFrame::Scene;
    double brightness = 1.0;
    double roughness = 0.25;
    double reverberation = 0.4;
    double opacity = 0.6;
    int64_t label = 255;
    std::array<double, 3> centre_mm;
    std::array<double, 4> quaternion = {1.0, 0.0, 0.0, 0.0};
    std::array<double, 3> size_mm;
    void read(Fields& fields) {
        fields.read("frame", [&](const Value& value) { frame = read_ToolFrame(value); });
        fields.read("brightness", [&](const Value& value) { brightness = value.number({0.0, 1.0, {}}); });
        fields.read("roughness", [&](const Value& value) { roughness = value.number({0.0, 1.0, {}}); });
        fields.read("reverberation", [&](const Value& value) { reverberation = value.number({0.0, 0.9, {}}); });
        fields.read("opacity", [&](const Value& value) { opacity = value.number({0.0, 0.999, {}}); });
        fields.read("label", [&](const Value& value) { label = value.integer({1.0, 255.0, {}}); });
        fields.require("centre_mm", [&](const Value& value) { centre_mm = value.vector<3>({-1000000.0, 1000000.0, {}}); });
        fields.read("quaternion", [&](const Value& value) { quaternion = value.vector<4>({-1.001, 1.001, {}}); });
        fields.require("size_mm", [&](const Value& value) { size_mm = value.vector<3>({0.05, 10000.0, {}}); });
    }
};
void check(const Box& it, const Value& value);

struct Cylinder {
    static constexpr const char* title = "the tool cylinder";
    ToolFrame frame = ToolFrame::Scene;
    double brightness = 1.0;
    double roughness = 0.25;
    double reverberation = 0.4;
    double opacity = 0.6;
    int64_t label = 255;
    std::array<double, 3> tip_mm;
    std::array<double, 3> hub_mm;
    double diameter_mm = 0.7;
    void read(Fields& fields) {
        fields.read("frame", [&](const Value& value) { frame = read_ToolFrame(value); });
        fields.read("brightness", [&](const Value& value) { brightness = value.number({0.0, 1.0, {}}); });
        fields.read("roughness", [&](const Value& value) { roughness = value.number({0.0, 1.0, {}}); });
        fields.read("reverberation", [&](const Value& value) { reverberation = value.number({0.0, 0.9, {}}); });
        fields.read("opacity", [&](const Value& value) { opacity = value.number({0.0, 0.999, {}}); });
        fields.read("label", [&](const Value& value) { label = value.integer({1.0, 255.0, {}}); });
        fields.require("tip_mm", [&](const Value& value) { tip_mm = value.vector<3>({-1000000.0, 1000000.0, {}}); });
        fields.require("hub_mm", [&](const Value& value) { hub_mm = value.vector<3>({-1000000.0, 1000000.0, {}}); });
        fields.read("diameter_mm", [&](const Value& value) { diameter_mm = value.number({0.05, 10000.0, {}}); });
    }
};
void check(const Cylinder& it, const Value& value);

struct Needle {
    static constexpr const char* title = "the tool needle";
    ToolFrame frame = ToolFrame::Scene;
    double brightness = 1.0;
    double roughness = 0.25;
    double reverberation = 0.4;
    double opacity = 0.6;
    int64_t label = 255;
    std::array<double, 3> tip_mm;
    std::array<double, 3> hub_mm;
    double diameter_mm = 0.7;
    void read(Fields& fields) {
        fields.read("frame", [&](const Value& value) { frame = read_ToolFrame(value); });
        fields.read("brightness", [&](const Value& value) { brightness = value.number({0.0, 1.0, {}}); });
        fields.read("roughness", [&](const Value& value) { roughness = value.number({0.0, 1.0, {}}); });
        fields.read("reverberation", [&](const Value& value) { reverberation = value.number({0.0, 0.9, {}}); });
        fields.read("opacity", [&](const Value& value) { opacity = value.number({0.0, 0.999, {}}); });
        fields.read("label", [&](const Value& value) { label = value.integer({1.0, 255.0, {}}); });
        fields.require("tip_mm", [&](const Value& value) { tip_mm = value.vector<3>({-1000000.0, 1000000.0, {}}); });
        fields.require("hub_mm", [&](const Value& value) { hub_mm = value.vector<3>({-1000000.0, 1000000.0, {}}); });
        fields.read("diameter_mm", [&](const Value& value) { diameter_mm = value.number({0.05, 10000.0, {}}); });
    }
};
void check(const Needle& it, const Value& value);

using Tool = std::variant<Box, Cylinder, Needle>;
inline Tool read_Tool(const Value& value) {
    if (!value.json().is_object() || !value.json().contains("kind"))
        value.refuse("an object with a kind, one of box, cylinder, needle");
    switch (value.at("kind").word({"box", "cylinder", "needle"})) {
        case 0: return read_object<Box>(value);
        case 1: return read_object<Cylinder>(value);
        default: return read_object<Needle>(value);
    }
}

struct SpeckleModel {
    static constexpr const char* title = "SpeckleModel";
    int64_t seed{};
    std::vector<double> axial_mm;
    std::vector<double> lateral_mm;
    std::vector<double> elevation_mm;
    std::array<double, 3> cell_mm;
    std::vector<double> strength;
    double wavenumber_per_mm = 0.0;
    double looks = 1.0;
    double floor = 0.0;
    void read(Fields& fields) {
        fields.require("seed", [&](const Value& value) { seed = value.integer({0.0, 4294967295.0, {}}); });
        fields.require("axial_mm", [&](const Value& value) { axial_mm = value.numbers({0.001, 100.0, {}}, {}); });
        fields.require("lateral_mm", [&](const Value& value) { lateral_mm = value.numbers({0.001, 100.0, {}}, {}); });
        fields.require("elevation_mm", [&](const Value& value) { elevation_mm = value.numbers({0.001, 100.0, {}}, {}); });
        fields.require("cell_mm", [&](const Value& value) { cell_mm = value.vector<3>({0.001, 100.0, {}}); });
        fields.require("strength", [&](const Value& value) { strength = value.numbers({0.0, 1.0, {}}, {}); });
        fields.read("wavenumber_per_mm", [&](const Value& value) { wavenumber_per_mm = value.number({0.0, 1000.0, {}}); });
        fields.read("looks", [&](const Value& value) { looks = value.number({1.0, 2.0, {}}); });
        fields.read("floor", [&](const Value& value) { floor = value.number({0.0, 10000.0, {}}); });
    }
};
void check(const SpeckleModel& it, const Value& value);

struct Breathing {
    static constexpr const char* title = "Breathing";
    double period_s = 4.0;
    double depth = 1.0;
    void read(Fields& fields) {
        fields.read("period_s", [&](const Value& value) { period_s = value.number({0.2, 60.0, {}}); });
        fields.read("depth", [&](const Value& value) { depth = value.number({0.0, 2.0, {}}); });
    }
};
void check(const Breathing& it, const Value& value);

enum class Below { Refuse, Mask };
inline Below read_Below(const Value& value) { return static_cast<Below>(value.word({"refuse", "mask"})); }

enum class Contact { Air, Pressure };
inline Contact read_Contact(const Value& value) { return static_cast<Contact>(value.word({"air", "pressure"})); }

enum class Speckle { Off, Natural };
inline Speckle read_Speckle(const Value& value) { return static_cast<Speckle>(value.word({"off", "natural"})); }

enum class Encoding { Uint8, Float32, Float16, Png, Jpeg, Npz };
inline Encoding read_Encoding(const Value& value) { return static_cast<Encoding>(value.word({"uint8", "float32", "float16", "png", "jpeg", "npz"})); }

struct RenderSettings {
    static constexpr const char* title = "RenderSettings";
    std::optional<int64_t> height;
    std::optional<int64_t> width;
    std::optional<Probe> probe;
    std::optional<double> min_confidence;
    Below below_min_confidence = Below::Refuse;
    std::optional<double> slice_thickness_mm;
    std::optional<Contact> contact;
    std::optional<double> indentation_mm;
    std::optional<std::vector<Tool>> tools;
    std::optional<double> ghost;
    std::optional<std::vector<double>> phase;
    std::optional<Breathing> breathing;
    Speckle speckle = Speckle::Off;
    std::optional<Display> display;
    std::vector<std::string> outputs = {"bmode"};
    Encoding encoding = Encoding::Uint8;
    std::optional<std::string> registration;
    void read(Fields& fields) {
        fields.read("height", [&](const Value& value) { height = value.integer({1.0, 4096.0, {}}); });
        fields.read("width", [&](const Value& value) { width = value.integer({1.0, 4096.0, {}}); });
        fields.read("probe", [&](const Value& value) { probe = read_Probe(value); });
        fields.read("min_confidence", [&](const Value& value) { min_confidence = value.number({0.0, 1.0, {}}); });
        fields.read("below_min_confidence", [&](const Value& value) { below_min_confidence = read_Below(value); });
        fields.read("slice_thickness_mm", [&](const Value& value) { slice_thickness_mm = value.number({0.0, 100.0, {}}); });
        fields.read("contact", [&](const Value& value) { contact = read_Contact(value); });
        fields.read("indentation_mm", [&](const Value& value) { indentation_mm = value.number({0.0, 50.0, {}}); });
        fields.read("tools", [&](const Value& value) { tools = read_list<Tool>(value, 8, [](const Value& value) { return read_Tool(value); }); });
        fields.read("ghost", [&](const Value& value) { ghost = value.number({0.0, 1.0, {}}); });
        fields.read("phase", [&](const Value& value) { phase = value.numbers({}, 8); });
        fields.read("breathing", [&](const Value& value) { breathing = read_object<Breathing>(value); });
        fields.read("speckle", [&](const Value& value) { speckle = read_Speckle(value); });
        fields.read("display", [&](const Value& value) { display = read_object<Display>(value); });
        fields.read("outputs", [&](const Value& value) { outputs = read_list<std::string>(value, {}, [](const Value& value) { return value.text(); }); });
        fields.read("encoding", [&](const Value& value) { encoding = read_Encoding(value); });
        fields.read("registration", [&](const Value& value) { registration = value.text(); });
    }
};
void check(const RenderSettings& it, const Value& value);
}  // namespace ultragray::library
