// JSON into the contract's structures: what a field may be is checked as it is read, and told as every other door tells it.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <nlohmann/json.hpp>
#include <optional>
#include <set>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace ultragray::library {

using Json = nlohmann::json;

// Wrong input: what was given, what was expected, and where, in a sentence.
class Fault : public std::runtime_error {
    using std::runtime_error::runtime_error;
};

inline std::string in_words(double number) {
    char text[32];
    std::snprintf(text, sizeof text, "%g", number);
    return text;
}

// The limits of a number.
struct Range {
    std::optional<double> low, high, above;

    bool holds(double number) const {
        return std::isfinite(number) && (!low || number >= *low) && (!high || number <= *high) &&
               (!above || number > *above);
    }
    std::string in_words() const {
        using library::in_words;
        if (low && high) return " from " + in_words(*low) + " to " + in_words(*high);
        if (low) return " of at least " + in_words(*low);
        if (above) return " above " + in_words(*above) + (high ? " and at most " + in_words(*high) : "");
        return high ? " of at most " + in_words(*high) : "";
    }
};

inline std::string joined(const std::vector<std::string>& words) {
    std::string text;
    for (const std::string& word : words) text += (text.empty() ? "" : ", ") + word;
    return text;
}

// A value as messages show it, cut where it is long. Never what is inside of lists and objects: a file may nest them by the
// million.
inline std::string shown(const Json& value) {
    constexpr size_t kMost = 100;
    if (value.is_array()) return "a list of " + std::to_string(value.size()) + " values";
    if (value.is_object()) return "an object of " + std::to_string(value.size()) + " entries";
    std::string text = value.is_string() ? "'" + value.get<std::string>() + "'" : value.dump();
    if (text.size() > kMost) text = text.substr(0, kMost) + "…";
    return text;
}

// One value of a document, and where it stands.
class Value {
 public:
    Value(const Json& json, std::string path) : json_(&json), path_(std::move(path)) {}
    const Json& json() const { return *json_; }

    [[noreturn]] void refuse(const std::string& expected) const {
        throw Fault((path_.empty() ? "" : path_ + " ") + "must be " + expected + ", got " + shown(*json_));
    }
    [[noreturn]] void fail(const std::string& field, const std::string& sentence) const {
        throw Fault((path_.empty() ? "" : path_ + ".") + field + " " + sentence);
    }
    // A part of an object, or of a list.
    Value at(const std::string& name) const { return {json_->at(name), path_.empty() ? name : path_ + "." + name}; }
    Value at(size_t place) const { return {json_->at(place), path_ + "[" + std::to_string(place) + "]"}; }

    double number(const Range& range) const {
        if (!json_->is_number() || !range.holds(json_->get<double>())) refuse("a finite number" + range.in_words());
        return json_->get<double>();
    }
    int64_t integer(const Range& range) const {
        if (!json_->is_number_integer() || !range.holds(json_->get<double>())) refuse("an integer" + range.in_words());
        return json_->get<int64_t>();
    }
    bool flag() const {
        if (!json_->is_boolean()) refuse("true or false");
        return json_->get<bool>();
    }
    std::string text() const {
        if (!json_->is_string()) refuse("a text");
        return json_->get<std::string>();
    }
    // The place of a word among those that it may be.
    int word(const std::vector<std::string>& words) const {
        for (size_t k = 0; k < words.size(); ++k)
            if (json_->is_string() && json_->get_ref<const std::string&>() == words[k]) return static_cast<int>(k);
        refuse("one of " + joined(words));
    }
    // The elements of a list: at most so many, or exactly.
    std::vector<Value> list(std::optional<size_t> most, std::optional<size_t> count = {}) const {
        if (!json_->is_array()) refuse("a list");
        if (most && json_->size() > *most)
            throw Fault(path_ + " must be a list of at most " + std::to_string(*most) + " values, got " +
                        std::to_string(json_->size()));
        if (count && json_->size() != *count) refuse("a list of " + std::to_string(*count) + " values");
        std::vector<Value> found;
        for (size_t k = 0; k < json_->size(); ++k) found.push_back(at(k));
        return found;
    }
    std::vector<double> numbers(const Range& range, std::optional<size_t> most) const {
        std::vector<double> found;
        for (const Value& one : list(most)) found.push_back(one.number(range));
        return found;
    }
    template <size_t N>
    std::array<double, N> vector(const Range& range) const {
        std::array<double, N> found;
        const auto values = list(N, N);
        for (size_t k = 0; k < N; ++k) found[k] = values[k].number(range);
        return found;
    }

 private:
    const Json* json_;
    std::string path_;
};

template <class Element, class Read>
std::vector<Element> read_list(const Value& value, std::optional<size_t> most, const Read& read) {
    std::vector<Element> found;
    for (const Value& one : value.list(most)) found.push_back(read(one));
    return found;
}

// An object whose fields are read one by one; what is null, or is not there, keeps its default.
class Fields {
 public:
    Fields(const Value& object, std::string title) : object_(object), title_(std::move(title)) {
        if (!object.json().is_object()) object.refuse("an object");
    }
    template <class Read>
    void read(const char* name, const Read& read) {
        known_.push_back(name);
        if (object_.json().contains(name) && !object_.json().at(name).is_null()) read(object_.at(name));
    }
    template <class Read>
    void require(const char* name, const Read& read) {
        known_.push_back(name);
        if (!object_.json().contains(name)) object_.fail(name, "is required by " + title_);
        read(object_.at(name));
    }
    // Raises Fault for keys that were not read.
    void end() const {
        for (const auto& item : object_.json().items()) {
            bool found = item.key() == "kind";
            for (const std::string& name : known_) found = found || name == item.key();
            if (!found) object_.fail(item.key(), "is not a known key: " + title_ + " takes " + joined(known_));
        }
    }

 private:
    Value object_;
    std::string title_;
    std::vector<std::string> known_;
};

// A structure of the contract: its fields, no others, and what they mean together (checks.cpp).
template <class Structure>
Structure read_object(const Value& object) {
    Structure it;
    Fields fields(object, Structure::title);
    it.read(fields);
    fields.end();
    check(it, object);
    return it;
}

}  // namespace ultragray::library
