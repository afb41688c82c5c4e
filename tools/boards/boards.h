// Which service runs on which board: a file of deploy/boards.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

namespace orthonav::boards {

struct Board {
  std::string name;
  std::string address;                // on the network between the boards
  std::vector<std::string> services;  // ingest, vio, map_server, registration, fusion, record
};

// Reads the boards of a file. Throws ConfigError with file and line: for an unknown service, for one that is on two
// boards, and for one of the five of the chain that is on none.
std::vector<Board> load(const std::filesystem::path& file);

// The systemd target of a board: it wants the board's services and takes them down with it.
std::string target_unit(const Board& board, const std::filesystem::path& file);

// Name of a service's unit.
std::string unit_of(const std::string& service);

}  // namespace orthonav::boards
