#!/usr/bin/env bash
# A board whose firewall drops what its own services say: each ends with an error that names the bus and what to look at, and
# none crashes: tests/status/deaf_bus_test.sh BIN CONFIG. Skips (77) where network namespaces or nft are not permitted.
set -euo pipefail
export PATH=$PATH:/usr/sbin:/sbin
if [ "${ORTHONAV_DEAF_BUS_TEST:-}" != inside ]; then
  problem=$(unshare -rn nft list ruleset 2>&1) || { echo "skipped: $problem"; exit 77; }
  ORTHONAV_DEAF_BUS_TEST=inside exec unshare -rn "$0" "$@"
fi
bin=$1 config=$2
ip link set lo up
ip route add 224.0.0.0/4 dev lo
nft add table inet deaf
nft 'add chain inet deaf in { type filter hook input priority 0; policy drop; }'
ends() { # exit code, program, arguments
  local expected=$1 status=0 said
  shift
  said=$("$@" 2>&1) || status=$?
  [ "$status" = "$expected" ] || { echo "$1 ended with $status: $said"; return 1; }
  [[ $said == *"nothing comes back from the bus at udpm://"*firewall* ]] || { echo "$1 said: $said"; return 1; }
}
ends 1 "$bin/orthonav-fusion" --config "$config" &
fusion=$!
ends 3 "$bin/orthonav-status"
wait $fusion
