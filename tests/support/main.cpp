// Runs a test program in a temporary folder of its own: ctest starts each test as a process, and two that write the
// same file name under testing::TempDir() at a time would read each other's.
#include <cstdlib>

#include <gmock/gmock.h>

#include "tests/support/temporary_folder.h"

int main(int argc, char** argv) {
  const orthonav::test::TemporaryFolder folder;
  setenv("TEST_TMPDIR", folder.path().c_str(), 1);  // testing::TempDir()
  setenv("TMPDIR", folder.path().c_str(), 1);       // std::filesystem::temp_directory_path()
  setenv("ORTHONAV_BIN", ORTHONAV_BIN, 0);          // what scripts of deploy/ run: this build's programs
  testing::InitGoogleMock(&argc, argv);
  return RUN_ALL_TESTS();
}
