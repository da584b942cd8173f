#include "compressed.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>

#include "document.hpp"

namespace ultragray::library {
namespace {

constexpr size_t kHead = 8, kColumn = 17, kChecksum = 4, kMostExpansion = 1032;  // the last: of deflate
constexpr int kCellBits = 7, kMostRestBits = 32, kMostPlanes = 4;
constexpr double kRatios[] = {0.12, 0.35, 0.75, 1.35, 2.0, 2.7, 3.4, 4.1};

template <class Number>
Number little_endian(const unsigned char* bytes) {
    Number value;  // every target of the library stores numbers so
    std::memcpy(&value, bytes, sizeof value);
    return value;
}

// A canonical Huffman code of RFC 1951: how many words there are of each length, and their symbols in order.
struct Code {
    static constexpr int kLongest = 15;
    std::array<int, kLongest + 1> counts{};
    std::vector<uint16_t> symbols;

    explicit Code(const std::vector<uint8_t>& lengths) {
        for (int length = 1, left = 1; length <= kLongest; ++length) {
            for (size_t symbol = 0; symbol < lengths.size(); ++symbol)
                if (lengths[symbol] == length) symbols.push_back(uint16_t(symbol)), ++counts[length];
            left = 2 * left - counts[length];
            if (left < 0) throw Fault("more words than a code can have");
        }
    }
};

// Deflated data (RFC 1951) that inflates to a known number of bytes. Throws Fault.
class Inflater {
 public:
    Inflater(const unsigned char* data, size_t size, size_t inflated) : data_(data), end_(data + size), size_(inflated) {}

    std::vector<uint8_t> run() {
        found_.reserve(size_);
        for (bool last = false; !last;) {
            last = bits(1);
            switch (bits(2)) {
                case 0:
                    store();
                    break;
                case 1:
                    expand(fixed_literals(), Code(std::vector<uint8_t>(30, 5)));
                    break;
                case 2:
                    expand_by_codes();
                    break;
                default:
                    throw Fault("a block of no kind");
            }
        }
        if (found_.size() != size_) throw Fault("another size");
        return std::move(found_);
    }

 private:
    int bits(int count) {
        for (; held_ < count; held_ += 8) {
            if (data_ == end_) throw Fault("cut off");
            hold_ |= uint32_t(*data_++) << held_;
        }
        const int value = int(hold_ & ((1u << count) - 1));
        hold_ >>= count;
        held_ -= count;
        return value;
    }
    int symbol(const Code& code) {
        int word = 0, first = 0, index = 0;
        for (int length = 1; length <= Code::kLongest; ++length) {
            word |= bits(1);
            const int count = code.counts[length];
            if (word - first < count) return code.symbols[index + word - first];
            index += count;
            first = 2 * (first + count);
            word *= 2;
        }
        throw Fault("a word of no code");
    }
    void put(uint8_t byte) {
        if (found_.size() == size_) throw Fault("another size");
        found_.push_back(byte);
    }
    void store() {
        hold_ = 0;
        held_ = 0;
        const int length = bits(16), inverse = bits(16);
        if ((length ^ inverse) != 0xFFFF || end_ - data_ < length) throw Fault("cut off");
        for (int k = 0; k < length; ++k) put(*data_++);
    }
    static Code fixed_literals() {
        std::vector<uint8_t> lengths(288, 8);
        std::fill(lengths.begin() + 144, lengths.begin() + 256, 9);
        std::fill(lengths.begin() + 256, lengths.begin() + 280, 7);
        return Code(lengths);
    }
    void expand_by_codes() {
        static constexpr int kOrder[] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
        const int literals = bits(5) + 257, distances = bits(5) + 1, given = bits(4) + 4;
        std::vector<uint8_t> lengths(19, 0);
        for (int k = 0; k < given; ++k) lengths[kOrder[k]] = uint8_t(bits(3));
        const Code of_lengths(lengths);
        lengths.clear();
        while (lengths.size() < size_t(literals + distances)) {
            const int one = symbol(of_lengths);
            if (one == 16 && lengths.empty()) throw Fault("nothing to repeat");
            const int times = one < 16 ? 1 : one == 16 ? 3 + bits(2) : one == 17 ? 3 + bits(3) : 11 + bits(7);
            lengths.insert(lengths.end(), times, uint8_t(one < 16 ? one : one == 16 ? lengths.back() : 0));
        }
        lengths.resize(literals + distances);
        expand(Code({lengths.begin(), lengths.begin() + literals}), Code({lengths.begin() + literals, lengths.end()}));
    }
    void expand(const Code& literals, const Code& distances) {
        static constexpr int kLengths[] = {3,  4,  5,  6,  7,  8,  9,  10, 11,  13,  15,  17,  19,  23, 27,
                                           31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258};
        for (int one; (one = symbol(literals)) != 256;) {
            if (one < 256) {
                put(uint8_t(one));
                continue;
            }
            if (one > 285) throw Fault("a length of no kind");
            const int extra = one < 265 || one == 285 ? 0 : (one - 261) / 4;
            const int length = kLengths[one - 257] + bits(extra), far = symbol(distances);
            if (far > 29) throw Fault("a distance of no kind");
            const int more = far < 4 ? 0 : far / 2 - 1;
            const size_t distance = size_t(far < 4 ? far + 1 : ((2 + far % 2) << more) + 1) + bits(more);
            if (distance > found_.size()) throw Fault("a distance before the beginning");
            for (int k = 0; k < length; ++k) put(found_[found_.size() - distance]);
        }
    }

    const unsigned char *data_, *end_;
    size_t size_;
    std::vector<uint8_t> found_;
    uint32_t hold_ = 0;
    int held_ = 0;
};

// What a part tells of each Gaussian: a least value, and how many steps above it.
struct Column {
    double low, step;
    int planes;
    std::vector<uint64_t> steps;

    double at(size_t i) const { return low + step * double(steps[i]); }
};

// By how much a turn is finer about the axis across two of these scales (log).
double fineness(float a, float b) {
    const double apart = std::fabs(double(a) - double(b));
    return std::ldexp(1.0, int(std::lower_bound(std::begin(kRatios), std::end(kRatios), apart) - kRatios));
}

}  // namespace

uint32_t checksum(const void* bytes, size_t size, uint32_t before) {
    static const std::array<uint32_t, 256> kTable = [] {
        std::array<uint32_t, 256> table{};
        for (uint32_t k = 0; k < table.size(); ++k) {
            table[k] = k;
            for (int bit = 0; bit < 8; ++bit) table[k] = table[k] >> 1 ^ (table[k] & 1 ? 0xEDB88320u : 0);
        }
        return table;
    }();
    uint32_t found = ~before;
    for (const auto* byte = static_cast<const unsigned char*>(bytes); size > 0; --size, ++byte)
        found = kTable[(found ^ *byte) & 0xFF] ^ found >> 8;
    return ~found;
}

void append_part(Parameters& into, const unsigned char* part, size_t size, int64_t most, const std::string& name) {
    const size_t width = 12 + size_t(into.terms) + (into.has_labels ? 1 : 0), table = kHead + width * kColumn;
    if (size < table + kChecksum || little_endian<uint32_t>(part + size - kChecksum) != checksum(part, size - kChecksum))
        throw Fault("its " + name + " is damaged: its checksum differs");
    const size_t count = little_endian<uint32_t>(part), rest_bits = little_endian<uint32_t>(part + 4);
    std::vector<Column> columns(width);
    size_t planes = 0;
    bool fits = count > 0 && int64_t(count) <= most && rest_bits <= kMostRestBits;
    for (size_t k = 0; k < width; ++k) {
        const unsigned char* row = part + kHead + k * kColumn;
        columns[k] = {little_endian<double>(row), little_endian<double>(row + 8), row[16], {}};
        planes += row[16];
        fits = fits && row[16] <= kMostPlanes;
    }
    if (!fits) throw Fault("its " + name + " has a head that it cannot have");
    const size_t deflated = size - table - kChecksum;
    std::vector<uint8_t> bytes;
    try {
        if (count * planes > kMostExpansion * deflated) throw Fault("more than it can hold");
        bytes = Inflater(part + table, deflated, count * planes).run();
    } catch (const Fault&) {
        throw Fault("its " + name + " is not of the size that its head says");
    }
    const uint8_t* plane = bytes.data();
    for (Column& column : columns) {
        column.steps.resize(count);
        for (int k = 0; k < column.planes; ++k, plane += count)
            for (size_t i = 0; i < count; ++i) column.steps[i] = column.steps[i] << 8 | plane[i];
    }
    const Column *mean = &columns[1], *scale = mean + 3, *turn = scale + 3, *tau = turn + 3, *sh = tau + 1;
    uint64_t cell = 0;
    for (size_t i = 0; i < count; ++i) {
        cell += columns[0].steps[i];
        for (int axis = 0; axis < 3; ++axis) {
            uint64_t place = mean[axis].steps[i];
            for (int bit = 0; bit < kCellBits; ++bit) place |= (cell >> (3 * bit + axis) & 1) << (rest_bits + bit);
            into.means.push_back(float(mean[axis].low + mean[axis].step * double(place)));
        }
        float log_scales[3];
        for (int axis = 0; axis < 3; ++axis) into.scales.push_back(log_scales[axis] = float(scale[axis].at(i)));
        into.quats.push_back(1.0f);
        for (int axis = 0; axis < 3; ++axis)
            into.quats.push_back(float(turn[axis].at(i) / fineness(log_scales[(axis + 1) % 3], log_scales[(axis + 2) % 3])));
        into.transmittances.push_back(float(tau->at(i)));
        into.sh0.push_back(float(sh->at(i)));
        for (int64_t k = 1; k <= into.terms; ++k) into.shn.push_back(float(sh[k].at(i)));
        if (into.has_labels) into.labels.push_back(uint8_t(columns.back().at(i)));
    }
}

}  // namespace ultragray::library
