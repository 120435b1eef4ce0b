// Runs an exported policy on a robot, as loop.py does: dry, damp, stand, policy, stop, with the same limits and log.
//
//   g++ -std=c++17 -O2 loop.cpp onnx_graph.cpp -I$ORT/include -L$ORT/lib -lonnxruntime -pthread -o loop
//   ./loop EXPORT --port 47010              # words of yours lead: stand, policy, stop, damp, or a command's numbers
//   ./loop EXPORT --port 47010 --seconds 10
//
// The robot here speaks text on the loopback address (udp_robot.h). For one of yours write a class with `read` and
// `write` (see robot_link.h), and give it to `drive` in place of this one. Read docs/deploy.md.

#include "drive.h"
#include "udp_robot.h"

int main(int count, char** arguments) try {
  const ksim::Options options = ksim::parse_options(count, arguments);
  if (options.port == 0) throw std::runtime_error("--port: expected the robot's port on the loopback address");
  ksim::PolicyControl control(options.folder, ksim::read_json(options.folder + "/export.json"));
  ksim::UdpRobot robot(options.port);
  return ksim::drive(robot, control, options);
} catch (const std::exception& error) {
  std::cerr << "loop: error: " << error.what() << "\n";
  return 2;
}
