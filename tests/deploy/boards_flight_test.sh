#!/usr/bin/env bash
# The chain over three boards, its bus sealed with a key and 1 % of the packets lost, finds its place on the map:
# tests/deploy/boards_flight_test.sh BIN FLIGHT_FOLDER. Skips (77) where network namespaces are not permitted.
set -euo pipefail
here=$(cd "$(dirname "$0")/../.." && pwd)
export ORTHONAV_BIN=$1
flight=$2
out=$flight/boards.lcm
export ORTHONAV_BUS_KEY=$flight/bus.key
(umask 077 && od -An -tx1 -N32 /dev/urandom | tr -d ' \n' >"$ORTHONAV_BUS_KEY")
"$here/deploy/fly-boards" "$here/deploy/boards/three.yaml" "$here/config/quick" "$flight/flight.lcm" "$flight/flight.onmap" "$out" \
  --loss 10 --seconds 35
for host in eyes atlas navigator; do
  grep -q "\"host\": \"$host\"" "${out%.lcm}.status.json" || { echo "no heartbeat from the board $host"; exit 1; }
done
"$ORTHONAV_BIN/orthonav-evaluate" "$out" --tum "$flight/boards-tum"
positions=$(wc -l <"$flight/boards-tum/fusion.tum")
[ "$positions" -ge 20 ] || { echo "only $positions positions on the map"; exit 1; }
