// A program started by a test, ended with it.
#pragma once

#include <chrono>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include <fcntl.h>
#include <sys/wait.h>
#include <unistd.h>

namespace orthonav::test {

// A program of this build, or of the folder $ORTHONAV_BIN, as for the scripts of deploy/; and the top of the source
// tree.
inline std::filesystem::path program(const std::string& name) {
  const char* folder = std::getenv("ORTHONAV_BIN");
  return std::filesystem::path(folder != nullptr ? folder : ORTHONAV_BIN) / name;
}
inline std::filesystem::path source_tree() {
  return ORTHONAV_SOURCE;
}

class ChildProcess {
 public:
  // Starts arguments[0]. With `output`, both of its streams go to that file.
  explicit ChildProcess(const std::vector<std::string>& arguments, const std::filesystem::path& output = {}) {
    std::vector<char*> argv;
    argv.reserve(arguments.size() + 1);
    for (const auto& argument : arguments) argv.push_back(const_cast<char*>(argument.c_str()));
    argv.push_back(nullptr);
    pid_ = fork();
    if (pid_ < 0) throw std::runtime_error("fork failed");
    if (pid_ == 0) {
      if (!output.empty()) {
        const int fd = open(output.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0644);
        dup2(fd, STDOUT_FILENO);
        dup2(fd, STDERR_FILENO);
      }
      execv(argv[0], argv.data());
      _exit(127);
    }
  }
  ~ChildProcess() {
    if (!exit_code_) {
      kill(pid_, SIGKILL);
      waitpid(pid_, nullptr, 0);
    }
  }
  ChildProcess(const ChildProcess&) = delete;
  ChildProcess& operator=(const ChildProcess&) = delete;

  void signal(int number) const { kill(pid_, number); }
  bool running() { return !wait_exit(std::chrono::milliseconds(0)); }

  // Exit code (128 + signal if killed), or nullopt if it still runs at the deadline.
  std::optional<int> wait_exit(std::chrono::milliseconds deadline) {
    const auto end = std::chrono::steady_clock::now() + deadline;
    for (;;) {
      int status = 0;
      if (!exit_code_ && waitpid(pid_, &status, WNOHANG) == pid_) {
        exit_code_ = WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
      }
      if (exit_code_ || std::chrono::steady_clock::now() >= end) return exit_code_;
      std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
  }

 private:
  pid_t pid_ = -1;
  std::optional<int> exit_code_;
};

}  // namespace orthonav::test
