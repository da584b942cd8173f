#include "scene_file.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <map>

#include "compressed.hpp"

namespace ultragray::library {
namespace {

constexpr uint64_t kMostHeader = uint64_t(4) << 20, kNoHeader = uint64_t(1) << 40;
constexpr int64_t kMostPoses = 100'000;
constexpr float kMostMean = 1e6f, kMostLogScale = 20.0f, kMostOther = 1e6f, kLeastNorm = 1e-6f;
constexpr int kFormatVersion = 1;
constexpr uint32_t kCompressedFormat = 1;

struct Tensor {
    std::string type;
    std::vector<int64_t> shape;
    const unsigned char* data;
};

std::string in_words(const Tensor& tensor) {
    std::string sides;
    for (const int64_t side : tensor.shape) sides += (sides.empty() ? "" : ", ") + std::to_string(side);
    return tensor.type + " [" + sides + "]";
}

// The tensors of a bundle by name, and its metadata. Of the beginning of one, data is null of those that it cuts.
class Bundle {
 public:
    Bundle(const unsigned char* bytes, size_t size, Extent extent) : extent_(extent) {
        uint64_t length = 0;
        if (size < sizeof length) throw Fault("it is cut off: a scene file has at least 8 bytes");
        for (size_t k = 0; k < sizeof length; ++k) length |= uint64_t(bytes[k]) << (8 * k);
        if (length > kNoHeader)
            throw Fault("it does not begin as a scene file does: it is damaged, or a file of another kind");
        if (length > kMostHeader)
            throw Fault("the header of a scene file may have " + std::to_string(kMostHeader) + " bytes, it says " +
                        std::to_string(length));
        if (length > size - sizeof length) throw Fault("it is cut off: its header tells of more");
        const auto* text = reinterpret_cast<const char*>(bytes + sizeof length);
        const Json header = parsed(text, text + length, "its header is no JSON");
        const unsigned char* data = bytes + sizeof length + length;
        const uint64_t room = size - sizeof length - length;
        if (!header.is_object()) throw Fault("its header is no JSON object");
        for (const auto& [name, one] : header.items()) {
            if (name == "__metadata__") {
                metadata_ = one;
                continue;
            }
            tensors_[name] = tensor_of(name, one, data, room);
        }
    }

    // The text of its description.
    std::string description() const {
        if (!metadata_.is_object() || !metadata_.contains("ultragray") || !metadata_["ultragray"].is_string())
            throw Fault("it is a safetensors file, but not one of ultragray's");
        return metadata_["ultragray"].get<std::string>();
    }
    bool is_compressed() const { return has("compressed"); }
    // Throws Fault where the description or the poses of a compressed file are damaged.
    void check_checksum() const {
        const std::vector<uint8_t> says = values<uint8_t>(at("compressed", "U8", {8}));
        const std::string description = this->description();
        uint32_t found[] = {kCompressedFormat, checksum(description.data(), description.size())}, given[2];
        for (const char* name : {"training_poses", "pose_corrections", "rest_poses"})
            if (has(name)) {
                const Tensor& poses = at(name, "F64", tensors_.at(name).shape);
                found[1] = checksum(poses.data, size_of(poses), found[1]);
            }
        std::memcpy(given, says.data(), sizeof given);
        if (given[0] != found[0])
            throw Fault("it is compressed in another format version than " + std::to_string(kCompressedFormat));
        if (given[1] != found[1]) throw Fault("its description or its poses are damaged: their checksum differs");
    }
    // The Gaussians of its parts: of all of them, or of those that are there.
    Parameters parts(int64_t count, int64_t terms, bool has_labels) const {
        Parameters gaussians;
        gaussians.terms = terms - 1;
        gaussians.has_labels = has_labels;
        int64_t left = count;
        for (int index = 0; index < 100; ++index) {
            char name[16];
            std::snprintf(name, sizeof name, "part.%02d", index);
            if (!has(name) || (index > 0 && tensors_.at(name).data == nullptr)) break;
            const Tensor& part = at(name, "U8", {tensors_.at(name).shape.empty() ? 0 : tensors_.at(name).shape[0]});
            append_part(gaussians, part.data, size_t(part.shape[0]), left, name);
            left = count - int64_t(gaussians.sh0.size());
        }
        if (left == count || (left > 0 && extent_ == Extent::Whole))
            throw Fault("its parts hold " + std::to_string(count - left) + " Gaussians, its description says " +
                        std::to_string(count));
        return gaussians;
    }
    bool has(const std::string& name) const { return tensors_.count(name) > 0; }
    const Tensor& at(const std::string& name, const std::string& type, const std::vector<int64_t>& shape) const {
        if (!has(name)) throw Fault("its tensor " + name + " is missing");
        const Tensor& found = tensors_.at(name);
        if (found.type != type || found.shape != shape)
            throw Fault("its tensor " + name + " is " + in_words(found) + ", expected " + in_words({type, shape, nullptr}));
        if (found.data == nullptr) throw Fault("it is cut off: its header tells of more");
        return found;
    }
    // The Gaussians of a file that is not compressed.
    Parameters whole(int64_t count, int64_t terms, bool has_labels) const {
        if (extent_ == Extent::Beginning) throw Fault("only compressed scene files (.ugz) can be read in parts");
        const auto labels = has_labels ? values<uint8_t>(at("labels", "U8", {count})) : std::vector<uint8_t>();
        return {terms - 1,
                has_labels,
                floats("means", {count, 3}),
                floats("scales", {count, 3}),
                floats("quats", {count, 4}),
                floats("transmittances", {count}),
                floats("sh0", {count, 1, 1}),
                floats("shN", {count, terms - 1, 1}),
                labels};
    }
    std::vector<float> floats(const std::string& name, const std::vector<int64_t>& shape) const {
        return values<float>(at(name, "F32", shape));
    }
    std::vector<Pose> poses(const std::string& name) const {
        if (!has(name)) return {};
        const std::vector<int64_t>& shape = tensors_.at(name).shape;
        const int64_t count = shape.empty() ? 0 : shape[0];
        if (count > kMostPoses) throw Fault(name + " must be at most " + std::to_string(kMostPoses));
        const std::vector<double> matrices = values<double>(at(name, "F64", {count, 4, 4}));
        std::vector<Pose> found;
        for (int64_t p = 0; p < count; ++p)
            found.push_back(Pose::read(&matrices[16 * p], name + "[" + std::to_string(p) + "]"));
        return found;
    }
    template <class Number>
    static std::vector<Number> values(const Tensor& tensor) {
        std::vector<Number> found(size_of(tensor) / sizeof(Number));
        std::memcpy(found.data(), tensor.data, size_of(tensor));
        return found;
    }
    static Json parsed(const char* first, const char* last, const std::string& problem) {
        Json found = Json::parse(first, last, nullptr, false);
        if (found.is_discarded()) throw Fault(problem);
        return found;
    }

 private:
    static const std::map<std::string, int64_t>& sizes() {
        static const std::map<std::string, int64_t> kSizes = {{"F32", 4}, {"F64", 8}, {"U8", 1}};
        return kSizes;
    }
    static size_t size_of(const Tensor& tensor) {
        int64_t bytes = sizes().at(tensor.type);
        for (const int64_t side : tensor.shape) bytes *= side;
        return size_t(bytes);
    }
    Tensor tensor_of(const std::string& name, const Json& one, const unsigned char* data, uint64_t room) const {
        const auto wrong = [&] { return Fault("its header does not describe the tensor " + name); };
        if (!one.is_object() || !one.contains("dtype") || !one.contains("shape") || !one.contains("data_offsets"))
            throw wrong();
        const Json &type = one["dtype"], &shape = one["shape"], &offsets = one["data_offsets"];
        if (!type.is_string() || !sizes().count(type.get<std::string>()) || !shape.is_array() || shape.size() > 3 ||
            !offsets.is_array() || offsets.size() != 2 || !offsets[0].is_number_unsigned() ||
            !offsets[1].is_number_unsigned())
            throw wrong();
        Tensor tensor{type.get<std::string>(), {}, nullptr};
        int64_t bytes = sizes().at(tensor.type);
        for (const Json& side : shape) {
            if (!side.is_number_unsigned() || side.get<uint64_t>() > kNoHeader) throw wrong();
            tensor.shape.push_back(side.get<int64_t>());
            if (__builtin_mul_overflow(bytes, tensor.shape.back(), &bytes)) throw wrong();
        }
        const uint64_t begin = offsets[0].get<uint64_t>(), end = offsets[1].get<uint64_t>();
        if (begin > end || end - begin != uint64_t(bytes)) throw wrong();
        if (end <= room)
            tensor.data = data + begin;
        else if (extent_ == Extent::Whole)
            throw Fault("it is cut off: its header tells of more");
        return tensor;
    }

    Extent extent_;
    std::map<std::string, Tensor> tensors_;
    Json metadata_;
};

SceneInfo info_of(const std::string& text) {
    const Json document = Bundle::parsed(text.data(), text.data() + text.size(), "its metadata is no JSON");
    const Value whole(document, "");
    if (!document.is_object()) throw Fault("its metadata is not a JSON object");
    if (!document.contains("format_version") || document["format_version"] != kFormatVersion)
        throw Fault("it is of another format version than " + std::to_string(kFormatVersion));
    SceneInfo info;
    info.json = text;
    const auto given = [&](const char* name) { return document.contains(name) && !document[name].is_null(); };
    if (given("centre_mm")) info.centre_mm = whole.at("centre_mm").vector<3>({-1e6, 1e6, {}});
    if (given("probe")) info.probe = read_Probe(whole.at("probe"));
    if (given("image_height")) info.height = int(whole.at("image_height").integer({1.0, 1e6, {}}));
    if (given("image_width")) info.width = int(whole.at("image_width").integer({1.0, 1e6, {}}));
    if (given("intensity"))
        info.intensity = whole.at("intensity").word({"released", "sigmoid"}) ? Intensity::Sigmoid : Intensity::Released;
    if (given("sh_degree")) info.sh_degree = int(whole.at("sh_degree").integer({0.0, 3.0, {}}));
    if (given("gaussian_count")) info.gaussian_count = whole.at("gaussian_count").integer({0.0, 1e9, {}});
    if (given("beam")) info.beam = read_object<ElevationBeam>(whole.at("beam"));
    if (given("speckle")) info.speckle = read_object<SpeckleModel>(whole.at("speckle"));
    if (given("confidence") && !document["confidence"].empty())
        info.confidence = ConfidenceModel::read(whole.at("confidence"));
    if (given("tissue_shares")) info.tissue_shares = whole.at("tissue_shares").vector<3>({0.0, 1.0, {}});
    if (given("label_names")) {
        const Value names = whole.at("label_names");
        if (!names.json().is_object()) names.refuse("an object");
        for (const auto& [label, name] : names.json().items()) {
            const int number = std::atoi(label.c_str());
            if (number < 1 || number > 255 || !name.is_string()) names.refuse("a name for labels from 1 to 255");
            info.label_names.emplace_back(number, name.get<std::string>());
        }
        std::sort(info.label_names.begin(), info.label_names.end());
    }
    return info;
}

void check_values(const std::string& name, const std::vector<float>& values, int64_t count, float most) {
    const int64_t width = count ? int64_t(values.size()) / count : 0;
    for (size_t k = 0; k < values.size(); ++k)
        if (!(std::fabs(values[k]) <= most))
            throw Fault("splats['" + name + "'] must be finite and within ±" + library::in_words(most) + ", got " +
                        library::in_words(values[k]) + " for Gaussian " + std::to_string(int64_t(k) / width));
}

// The Gaussians of one label, of which only weights are drawn.
std::unique_ptr<PreparedScene> part_of(const std::vector<uint8_t>& labels, int label, const RawSplats& raw) {
    const auto some_of = [&](const float* values, int width) {
        std::vector<float> some;
        for (int64_t i = 0; i < raw.count; ++i)
            if (labels[i] == label) some.insert(some.end(), values + width * i, values + width * (i + 1));
        return some;
    };
    const auto means = some_of(raw.means, 3), scales = some_of(raw.scales, 3), quats = some_of(raw.quats, 4);
    const auto transmittances = some_of(raw.transmittances, 1), sh0 = some_of(raw.sh0, 1);
    if (sh0.empty()) return nullptr;
    const RawSplats some{means.data(),  scales.data(), quats.data(),        transmittances.data(),
                         sh0.data(),    nullptr,       int64_t(sh0.size()), 0,
                         raw.intensity, false};
    return std::make_unique<PreparedScene>(some, Order::Sorted, 1);
}

}  // namespace

Scene Scene::read(const void* bytes, size_t size, Extent extent) {
    const Bundle bundle(static_cast<const unsigned char*>(bytes), size, extent);
    Scene scene;
    SceneInfo& info = scene.info;
    info = info_of(bundle.description());
    if (bundle.is_compressed()) bundle.check_checksum();
    const int64_t whole = info.gaussian_count, terms = int64_t(info.sh_degree + 1) * (info.sh_degree + 1);
    if (whole == 0) throw Fault("it holds no Gaussians");
    const bool has_labels = !info.label_names.empty();
    Parameters all =
        bundle.is_compressed() ? bundle.parts(whole, terms, has_labels) : bundle.whole(whole, terms, has_labels);
    const int64_t n = int64_t(all.sh0.size());
    if (n < whole) {  // where the small ones have not come, the large ones fill their place: a measured power
        for (float& scale : all.scales) scale += float(std::log(double(whole) / double(n)) / 8.0);
        Json document = Json::parse(info.json);
        document["gaussian_count"] = info.gaussian_count = n;
        info.json = document.dump();
    }
    check_values("means", all.means, n, kMostMean);
    check_values("scales", all.scales, n, kMostLogScale);
    check_values("quats", all.quats, n, kMostOther);
    check_values("transmittances", all.transmittances, n, kMostOther);
    check_values("sh0", all.sh0, n, kMostOther);
    check_values("shN", all.shn, n, kMostOther);
    for (int64_t i = 0; i < n; ++i) {
        const float* q = &all.quats[4 * i];
        if (std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]) < kLeastNorm)
            throw Fault("splats['quats'] must not be zero, got zero for Gaussian " + std::to_string(i));
    }
    const RawSplats raw{all.means.data(),
                        all.scales.data(),
                        all.quats.data(),
                        all.transmittances.data(),
                        all.sh0.data(),
                        all.shn.data(),
                        n,
                        info.sh_degree,
                        info.intensity,
                        false};
    scene.gaussians = std::make_unique<PreparedScene>(raw, Order::Sorted, 1);
    for (int label = 0; label < 256 && has_labels; ++label)
        if (auto part = part_of(all.labels, label, raw)) scene.parts.emplace_back(label, std::move(part));
    scene.training_poses = bundle.poses("training_poses");
    scene.rest_poses = bundle.poses("rest_poses");
    scene.errors = bundle.poses("pose_corrections");
    for (const auto* beside : {&scene.rest_poses, &scene.errors})
        if (!beside->empty() && beside->size() != scene.training_poses.size())
            throw Fault("there must be one of each pose beside the training poses");
    if (info.tissue_shares.has_value() == scene.rest_poses.empty() || (info.tissue_shares && !info.probe))
        throw Fault("tissue_shares, rest_poses (one or more) and a probe belong together");
    const size_t views = scene.training_poses.size();
    if (info.confidence && info.probe && views && info.confidence->formula.hardness.size() != views)
        throw Fault("confidence.hardness must have one number for each of " + std::to_string(views) +
                    " training poses, got " + std::to_string(info.confidence->formula.hardness.size()));
    return scene;
}

}  // namespace ultragray::library
