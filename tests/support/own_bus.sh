#!/usr/bin/env bash
# Runs a command on an LCM bus of its own: in a network namespace where that is allowed, else on loopback
# with a multicast port that no other test has.
set -eu
if unshare -rn true 2>/dev/null; then
  export LCM_DEFAULT_URL='udpm://239.255.76.67:7667?ttl=0'
  exec unshare -rn bash -c '
    ip link set lo up
    ip link set lo multicast on
    ip route add 224.0.0.0/4 dev lo
    exec "$@"' _ "$@"
fi
export LCM_DEFAULT_URL="udpm://239.255.76.67:$((20000 + $$ % 40000))?ttl=0"
exec "$@"
