// Reads JSON of export.json: values by name, and errors that name the place.
#pragma once

#include <cmath>
#include <cstdlib>
#include <fstream>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "text.h"

namespace ksim {

// A value of a JSON file. What is asked for and not there, or of another kind, is a std::runtime_error with its place.
class Json {
 public:
  enum class Kind { null, boolean, number, text, list, tree };
  using Members = std::vector<std::pair<std::string, Json>>;

  Kind kind = Kind::null;
  std::string place;

  bool is_null() const { return kind == Kind::null; }

  // The entry of a name; a missing one is an error.
  const Json& operator[](const std::string& name) const {
    const Json* found = find(name);
    if (found == nullptr) throw std::runtime_error(place + " has no entry " + name);
    return *found;
  }

  // The entry of a name, or nullptr.
  const Json* find(const std::string& name) const {
    expect(Kind::tree, "a mapping");
    for (const auto& [key, value] : members_) {
      if (key == name) return &value;
    }
    return nullptr;
  }

  const Members& members() const {
    expect(Kind::tree, "a mapping");
    return members_;
  }

  const std::vector<Json>& list() const {
    expect(Kind::list, "a list");
    return list_;
  }

  double number() const {
    expect(Kind::number, "a number");
    return number_;
  }

  // A number, or another where the file has null.
  double number_or(double otherwise) const { return is_null() ? otherwise : number(); }

  // A whole number of 0 or more.
  size_t count() const {
    const double value = number();
    if (value < 0.0 || value > 1e6 || value != std::floor(value)) {
      throw std::runtime_error(place + " is " + ksim::text("%g", value) + ": expected a whole number");
    }
    return static_cast<size_t>(value);
  }

  bool boolean() const {
    expect(Kind::boolean, "true or false");
    return boolean_;
  }

  const std::string& text() const {
    expect(Kind::text, "a text");
    return text_;
  }

  Numbers numbers() const {
    Numbers found;
    for (const auto& entry : list()) found.push_back(entry.number());
    return found;
  }

  Names texts() const {
    Names found;
    for (const auto& entry : list()) found.push_back(entry.text());
    return found;
  }

  // `size` numbers: the list's, or one for all.
  Numbers spread(size_t size) const {
    if (kind == Kind::number) return Numbers(size, number_);
    Numbers found = numbers();
    if (found.size() == 1) found.assign(size, found[0]);
    if (found.size() != size) {
      throw std::runtime_error(place + ": " + ksim::text("%zu numbers: expected %zu", found.size(), size));
    }
    return found;
  }

 private:
  friend class JsonReader;

  void expect(Kind wanted, const char* what) const {
    if (kind != wanted) throw std::runtime_error(place + ": expected " + what);
  }

  bool boolean_ = false;
  double number_ = 0.0;
  std::string text_;
  std::vector<Json> list_;
  Members members_;
};

// Makes a Json of text.
class JsonReader {
 public:
  JsonReader(std::string source, std::string name) : source_(std::move(source)), name_(std::move(name)) {}

  Json read() {
    Json value = parse(name_, 0);
    skip_blanks();
    if (at_ != source_.size()) fail("text behind the end");
    return value;
  }

 private:
  static constexpr int most_depth = 100;

  [[noreturn]] void fail(const std::string& why) const {
    throw std::runtime_error(name_ + ": " + why + text(" at character %zu", at_));
  }

  void skip_blanks() {
    while (at_ < source_.size() && std::string(" \t\r\n").find(source_[at_]) != std::string::npos) ++at_;
  }

  char next() {
    skip_blanks();
    if (at_ >= source_.size()) fail("it ends too soon");
    return source_[at_];
  }

  bool take(char wanted) {
    if (next() != wanted) return false;
    ++at_;
    return true;
  }

  void expect(char wanted) {
    if (!take(wanted)) fail(std::string("expected ") + wanted);
  }

  Json parse(const std::string& place, int depth) {
    if (depth > most_depth) fail("nested too deep");
    Json value;
    value.place = place;
    const char first = next();
    if (first == '{') {
      parse_tree(value, depth);
    } else if (first == '[') {
      parse_list(value, depth);
    } else if (first == '"') {
      value.kind = Json::Kind::text;
      value.text_ = parse_text();
    } else if (first == 't' || first == 'f') {
      value.kind = Json::Kind::boolean;
      value.boolean_ = first == 't';
      parse_word(first == 't' ? "true" : "false");
    } else if (first == 'n') {
      parse_word("null");
    } else {
      value.kind = Json::Kind::number;
      value.number_ = parse_number();
    }
    return value;
  }

  void parse_tree(Json& value, int depth) {
    value.kind = Json::Kind::tree;
    expect('{');
    if (take('}')) return;
    do {
      if (next() != '"') fail("expected a name");
      const std::string name = parse_text();
      expect(':');
      value.members_.emplace_back(name, parse(value.place + ": " + name, depth + 1));
    } while (take(','));
    expect('}');
  }

  void parse_list(Json& value, int depth) {
    value.kind = Json::Kind::list;
    expect('[');
    if (take(']')) return;
    do {
      value.list_.push_back(parse(value.place + text("[%zu]", value.list_.size()), depth + 1));
    } while (take(','));
    expect(']');
  }

  void parse_word(const std::string& word) {
    if (source_.compare(at_, word.size(), word) != 0) fail("expected " + word);
    at_ += word.size();
  }

  double parse_number() {
    const char* begin = source_.c_str() + at_;
    // What strtod takes beyond JSON, as "nan" and "inf", would be a limit without effect.
    if (*begin != '-' && (*begin < '0' || *begin > '9')) fail("expected a value");
    char* end = nullptr;
    const double value = std::strtod(begin, &end);
    if (end == begin || !std::isfinite(value)) fail("expected a finite number");
    at_ += static_cast<size_t>(end - begin);
    return value;
  }

  std::string parse_text() {
    std::string found;
    ++at_;
    while (true) {
      if (at_ >= source_.size()) fail("a text without an end");
      const char letter = source_[at_++];
      if (letter == '"') return found;
      found += letter == '\\' ? parse_escape() : std::string(1, letter);
    }
  }

  std::string parse_escape() {
    if (at_ >= source_.size()) fail("a text without an end");
    const char letter = source_[at_++];
    static const std::string named = "\"\\/bfnrt";
    static const std::string meant = "\"\\/\b\f\n\r\t";
    const size_t place = named.find(letter);
    if (place != std::string::npos) return std::string(1, meant[place]);
    if (letter != 'u' || at_ + 4 > source_.size()) fail("an unknown escape");
    const unsigned long code = std::strtoul(source_.substr(at_, 4).c_str(), nullptr, 16);
    at_ += 4;
    // Names of joints are plain letters; whatever else is only shown.
    return code < 128 ? std::string(1, static_cast<char>(code)) : "?";
  }

  std::string source_;
  std::string name_;
  size_t at_ = 0;
};

inline Json read_json(const std::string& path) {
  check_locale();
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error(path + " cannot be read");
  std::stringstream content;
  content << file.rdbuf();
  return JsonReader(content.str(), "export.json").read();
}

}  // namespace ksim
