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

// The firewall of each board, for nft: deploy/etc/orthonav.nft with the boards' addresses, the interface between them
// and the bus's port. A bus of one board stays on `lo` and lets nobody else in.
std::string firewall(const std::vector<Board>& boards, const std::string& interface, int port);

// The port of a bus's URL, e.g. udpm://239.255.76.67:7667?ttl=1. Throws std::invalid_argument for one that has none.
int port_of(const std::string& url);

// Name of a service's unit.
std::string unit_of(const std::string& service);

}  // namespace orthonav::boards
