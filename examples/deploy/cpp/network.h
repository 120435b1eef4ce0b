// Runs the networks of an export, with the states that they carry from step to step.
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "json.h"

namespace ksim {

// An input of a graph, for one robot.
struct Port {
  std::string name;
  std::vector<int64_t> shape;

  size_t size() const {
    size_t product = 1;
    for (int64_t edge : shape) product *= static_cast<size_t>(edge);
    return product;
  }
};

using Values = std::map<std::string, Numbers>;

// What computes outputs of inputs: onnxruntime in onnx_graph.cpp, which the loop is linked with.
class Graph {
 public:
  virtual ~Graph() = default;
  virtual const std::vector<Port>& inputs() const = 0;
  virtual std::vector<Numbers> run(const Values& given, const Names& outputs) = 0;
};

// Opens the graph in a file; defined by what the program is linked with.
std::unique_ptr<Graph> open_graph(const std::string& path);

// A graph with its states, as an entry of export.json describes them.
class Network {
 public:
  Network(const std::string& path, const Json& states, const std::string& output) : graph_(open_graph(path)) {
    for (const auto& port : graph_->inputs()) ports_[port.name] = port;
    outputs_.push_back(output);
    for (const auto& spec : states.list()) {
      specs_.push_back(State::read(spec));
      outputs_.push_back(spec["output"].text());
      if (ports_.count(specs_.back().input) == 0) {
        throw std::runtime_error(path + ": no input " + specs_.back().input + ", which export.json has as a state");
      }
    }
  }

  bool reads(const std::string& name) const { return ports_.count(name) != 0; }

  // Forget the episode.
  void reset() {
    states_.clear();
    next_states_.clear();
  }

  // Let the step end: what the last run has kept is read by the next one.
  void advance() { states_ = next_states_; }

  // The first output.
  Numbers run(const Values& given) {
    Values feed = given;
    for (const auto& [name, values] : given) {
      const auto port = ports_.find(name);
      if (port == ports_.end()) throw std::runtime_error("the network has no input " + name);
      if (values.size() == port->second.size()) continue;
      throw std::runtime_error(name + text(" has %zu numbers: expected %zu", values.size(), port->second.size()));
    }
    if (states_.empty()) begin(given);
    for (size_t k = 0; k < specs_.size(); ++k) feed[specs_[k].input] = states_[k];
    std::vector<Numbers> found = graph_->run(feed, outputs_);
    next_states_.assign(found.begin() + 1, found.end());
    return found[0];
  }

 private:
  struct State {
    std::string input;
    bool starts_with_frame = false;
    std::string source = "obs";
    size_t first = 0;
    size_t last = 0;  // 0: all columns

    static State read(const Json& spec) {
      State state;
      state.input = spec["input"].text();
      const Json* start = spec.find("starts_with");
      state.starts_with_frame = start != nullptr && !start->is_null() && start->text() == "frame";
      const Json* of = spec.find("of");
      if (of != nullptr && !of->is_null()) state.source = of->text();
      const Json* columns = spec.find("columns");
      if (columns != nullptr && !columns->is_null()) {
        state.first = columns->list().at(0).count();
        state.last = columns->list().at(1).count();
      }
      return state;
    }
  };

  // Begin an episode: with zeros, or with its first frame, or some columns of it, in all places.
  void begin(const Values& given) {
    states_.clear();
    for (const auto& spec : specs_) {
      const Port& port = ports_.at(spec.input);
      Numbers state(port.size(), 0.0);
      if (spec.starts_with_frame) {
        const Numbers& frame = given.at(spec.source);
        const size_t last = spec.last == 0 ? frame.size() : spec.last;
        const Numbers kept(frame.begin() + static_cast<long>(spec.first), frame.begin() + static_cast<long>(last));
        for (size_t k = 0; k < state.size(); ++k) state[k] = kept.at(k % kept.size());
      }
      states_.push_back(state);
    }
  }

  std::unique_ptr<Graph> graph_;
  std::map<std::string, Port> ports_;
  std::vector<State> specs_;
  Names outputs_;
  std::vector<Numbers> states_;
  std::vector<Numbers> next_states_;
};

}  // namespace ksim
