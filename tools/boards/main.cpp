// Reads which service runs on which board, for scripts and for systemd.
#include <cstdio>
#include <filesystem>
#include <fstream>

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <fmt/ranges.h>

#include "common/bus/node.h"
#include "tools/boards/boards.h"

int main(int argc, char** argv) {
  CLI::App app{"Reads which service runs on which board. Alone it prints one line a board, with address and services."};
  std::filesystem::path file, folder;
  std::string interface;
  app.add_option("file", file, "e.g. /usr/share/orthonav/boards/three.yaml")->required()->check(CLI::ExistingFile);
  app.add_option("--targets", folder, "write orthonav-BOARD.target for each board into this folder");
  app.add_option("--firewall", interface,
                 "print the boards' firewall for nft; the interface between them, and the port of LCM_DEFAULT_URL")
      ->excludes("--targets");
  CLI11_PARSE(app, argc, argv);
  try {
    if (!interface.empty()) {
      const std::string url = orthonav::bus_url({.service = "boards"});
      const int port = orthonav::boards::port_of(url);
      fmt::print(stderr, "for the bus at port {} (LCM_DEFAULT_URL)\n", port);
      fmt::print("{}", orthonav::boards::firewall(orthonav::boards::load(file), interface, port));
      return 0;
    }
    for (const auto& board : orthonav::boards::load(file)) {
      if (folder.empty()) {
        fmt::print("{} {} {}\n", board.name, board.address, fmt::join(board.services, " "));
        continue;
      }
      const auto unit = folder / ("orthonav-" + board.name + ".target");
      std::ofstream out(unit);
      out << orthonav::boards::target_unit(board, file);
      out.close();
      if (!out) throw std::runtime_error(unit.string() + ": cannot write");
    }
    return 0;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "orthonav-boards: %s\n", error.what());
    return 1;
  }
}
