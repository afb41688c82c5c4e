#!/usr/bin/env bash
# Makes the short flight that the playback tests fly, and replays it once: make_flight.sh BIN SOURCE FOLDER
set -euo pipefail
bin=$1 source=$2 folder=$3
mkdir -p "$folder"
"$bin/orthonav-simulate" --scenario "$source/config/quick" --seed 7 --duration 60 --out "$folder/flight.lcm"
"$bin/orthonav-build-map" "$folder/flight.map.tif" --config "$source/config/quick" --out "$folder/flight.onmap"
"$bin/orthonav-replay" --config "$source/config/quick" --log "$folder/flight.lcm" --map "$folder/flight.onmap" \
  --out "$folder/replayed.lcm"
