#!/usr/bin/env bash
# The recorder's unit keeps to its bound, and on a full disk keeps what it has, however often it is started again, and goes
# on when there is room: tests/deploy/recorder_test.sh BIN UNIT LOG. Skips (77) where namespaces are not permitted.
set -euo pipefail
here=$(cd "$(dirname "$0")/../.." && pwd)
if [ "${ORTHONAV_RECORDER_TEST:-}" != inside ]; then
  unshare -rnm true 2>/dev/null || { echo "skipped: namespaces are not permitted here"; exit 77; }
  ORTHONAV_RECORDER_TEST=inside exec "$here/deploy/own-bus" unshare -m "$0" "$@"
fi
bin=$(realpath "$1") log=$(realpath "$3")
export ORTHONAV_LOG_FILES=2 ORTHONAV_LOG_MB=1
command=$(sed -n 's/^ExecStart=//p' "$2")
disk=$(mktemp -d)
mount -t tmpfs -o size=6m none "$disk"
cd "$disk"

# Records the log as it is played, and says how the recorder ended: 0 as asked.
record() {
  eval "exec ${command//&/\\&}" >/dev/null 2>&1 &
  local recorder=$! deadline=$((SECONDS + 20)) status=0
  until grep -q ':1DF3 ' /proc/net/udp; do [ $SECONDS -lt $deadline ] || { echo "the recorder does not listen"; exit 1; }; done
  lcm-logplayer --speed=10 --lcm-url="$LCM_DEFAULT_URL" "$log" >/dev/null 2>&1 || true
  kill -TERM $recorder 2>/dev/null || true
  wait $recorder || status=$?
  return $status
}
kept() { stat -c '%s %n' flight.lcm.*; }

record || { echo "the recorder ended by itself"; exit 1; }
[ "$(du -ck flight.lcm.* | tail -1 | cut -f1)" -le 3500 ] || { echo "more than 3 files of 1 MB: $(kept)"; exit 1; }
head -c 6m /dev/zero >others 2>/dev/null || true # the disk is full
! record || { echo "the recorder says nothing of a full disk"; exit 1; }
before=$(kept)
for _ in 1 2 3; do record || true; done
[ "$(kept)" = "$before" ] ||
  { printf 'the recordings changed on a full disk from\n%s\nto\n%s\n' "$before" "$(kept)"; exit 1; }
rm others
record || { echo "the recorder does not go on when there is room"; exit 1; }
[ "$(kept)" != "$before" ] || { echo "nothing is recorded when there is room"; exit 1; }
for file in flight.lcm.*; do "$bin/orthonav-evaluate" "$file" >evaluated 2>&1 || { cat evaluated; exit 1; }; done
