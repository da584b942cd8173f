// How stiff tissues are, by the names of their labels: the one table, of published values.
#pragma once

#include <limits>
#include <string>

namespace ultragray {

struct Stiffness {
    const char* word;  // that a word of the label's name begins with
    double young_kpa;  // Young's modulus; infinite: it stays where it is
};

inline constexpr double kRigid = std::numeric_limits<double>::infinity();
inline constexpr double kSoftTissueKpa = 10.0;  // where no word is known, about that of muscle and of glands

// The first that fits counts.
inline constexpr Stiffness kStiffness[] = {
    // Thousands of times as stiff as soft tissue.
    {"bone", kRigid},
    {"vertebra", kRigid},
    {"spine", kRigid},
    {"rib", kRigid},
    {"skull", kRigid},
    {"calcification", kRigid},
    // Arda et al., American Journal of Roentgenology 197 (2011) 532: shear-wave elastography of 127 volunteers.
    {"muscle", 11.1},  // gastrocnemius
    {"tendon", 51.5},  // Achilles
    {"ligament", 51.5},
    {"fascia", 51.5},
    {"thyroid", 11.0},
    {"parotid", 10.4},
    {"submandibular", 10.9},
    {"kidney", 5.0},  // cortex
    {"pancreas", 4.8},
    {"spleen", 2.9},
    // Roulot et al., Journal of Hepatology 48 (2008) 606: transient elastography of 429 people without liver disease.
    {"liver", 5.5},
    // Samani, Zubovits and Plewes, Physics in Medicine and Biology 52 (2007) 1565: indentation of samples of breast.
    {"fat", 3.25},
    {"fibroglandular", 3.24},
};

inline double stiffness_kpa(const std::string& label) {
    const auto is_letter = [](char c) { return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z'); };
    std::string words = " ";
    for (const char c : label) words += is_letter(c) ? char(c | 0x20) : ' ';
    for (const Stiffness& one : kStiffness)
        if (words.find(std::string(" ") + one.word) != std::string::npos) return one.young_kpa;
    return kSoftTissueKpa;
}

}  // namespace ultragray
