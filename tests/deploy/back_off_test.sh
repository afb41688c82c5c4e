#!/usr/bin/env bash
# deploy/systemd/back-off: a service that fails now and then is started at once, one that keeps failing ever later, and after a
# quiet minute it begins anew: tests/deploy/back_off_test.sh. A `sleep` of our own says how long it was asked to.
set -euo pipefail
here=$(cd "$(dirname "$0")/../.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat >"$work/sleep" <<EOF
#!/bin/sh
echo "\$1" >>"$work/slept"
EOF
chmod 755 "$work/sleep"
export PATH=$work:$PATH
mkdir "$work/run"
waits() { # starts
  : >"$work/slept"
  for _ in $(seq "$1"); do "$here/deploy/systemd/back-off" "$work/run"; done
  tr '\n' ' ' <"$work/slept"
}
expect() { [ "$2" = "$3" ] || { echo "$1: waited '$2', not '$3'"; exit 1; }; }
expect "three starts" "$(waits 3)" ""
expect "five more" "$(waits 5)" "1 2 5 10 10 "
touch -d '61 seconds ago' "$work/run/starts"
expect "after a minute" "$(waits 4)" "1 "
