#!/usr/bin/env bash
# deploy/etc/orthonav.nft on a board: the boards' services are heard; nobody else's, nor what came through a router:
# tests/deploy/firewall_test.sh BIN CONFIG. Skips (77) where network namespaces or nft are not permitted.
set -euo pipefail
here=$(cd "$(dirname "$0")/../.." && pwd)
export PATH=$PATH:/usr/sbin:/sbin
if [ "${ORTHONAV_FIREWALL_TEST:-}" != inside ]; then
  problem=$(unshare -rnmpf --kill-child --mount-proc nft list ruleset 2>&1) || { echo "skipped: $problem"; exit 77; }
  ORTHONAV_FIREWALL_TEST=inside exec unshare -rnmpf --kill-child --mount-proc "$0" "$@"
fi
bin=$1 config=$2
unshare -n sleep infinity &
board=$!
until [ "$(readlink /proc/$board/ns/net)" != "$(readlink /proc/self/ns/net)" ]; do sleep 0.05; done
on_board() { nsenter -t "$board" -n "$@"; }
ip link set lo up
ip link add others type veth peer name eth0 netns "$board"
ip addr add 10.77.0.2/24 dev others # another board
ip addr add 10.77.0.9/24 dev others # and no board
ip link set others up
on_board bash -c 'ip link set lo up && ip addr add 10.77.0.1/24 dev eth0 && ip link set eth0 up && ip route add 224.0.0.0/4 dev eth0'
on_board nft -f "$here/deploy/etc/orthonav.nft"
dropped() { on_board nft list chain inet orthonav input | sed -n 's/.*dport 7667 counter packets \([0-9]*\).*/\1/p'; }

# Whether the board hears a service that speaks from an address, its packets living so many hops.
hears() { # address, hops
  ip route replace 224.0.0.0/4 dev others src "$1"
  "$bin/orthonav-fusion" --config "$config" --lcm-url "udpm://239.255.76.67:7667?ttl=$2" >/dev/null 2>&1 &
  local service=$! status=0
  on_board "$bin/orthonav-status" --lcm-url 'udpm://239.255.76.67:7667?ttl=1' --expect fusion --seconds 4 >/dev/null || status=$?
  kill -TERM $service
  wait $service || true
  [ $status -lt 2 ]
}
hears 10.77.0.2 1 || { echo "a board is not heard"; exit 1; }
[ "$(dropped)" = 0 ] || { echo "packets of a board were dropped"; exit 1; }
! hears 10.77.0.9 1 || { echo "who is no board is heard"; exit 1; }
strangers=$(dropped)
[ "$strangers" -gt 0 ] || { echo "nothing came from who is no board: the test tests nothing"; exit 1; }
! hears 10.77.0.2 3 || { echo "what may have come through a router is heard"; exit 1; }
[ "$(dropped)" -gt "$strangers" ] || { echo "nothing came with three hops: the test tests nothing"; exit 1; }
