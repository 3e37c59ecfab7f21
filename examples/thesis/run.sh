#!/bin/sh
# Every experiment of the thesis' chapters 6.2 and 6.4, into the current directory.  Usage: run.sh [ITERATIONS]
set -eu
here=$(dirname "$0")
iterations=${1:-1000}
for net in none sparse-uniform sparse-random dense-uniform; do
    caustic design "$here/../tophat.png" --config "$here/tophat-$net.toml" --iterations "$iterations" -o "tophat-$net.caustic"
done
for mag in 1 3 5; do
    for picture in flame ball; do
        caustic design "$here/../$picture.png" --config "$here/mag$mag.toml" --iterations "$iterations" \
            -o "$picture-mag$mag.caustic"
    done
done
caustic design "$here/../flame.png" --config "$here/point.toml" --iterations "$((iterations < 400 ? iterations : 400))" \
    -o point.caustic
