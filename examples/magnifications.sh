#!/bin/sh
# One picture at several magnifications: designs each lens, retraces it, and prints a table.  Run again, it designs only what is new.
# Usage: magnifications.sh PICTURE [MAG ...]
set -eu
picture=${1:?usage: magnifications.sh PICTURE [MAG ...]}
shift
[ $# -gt 0 ] || set -- 1 3 5
name=$(basename "$picture" | sed 's/\.[^.]*$//')
printf 'mag\trelative_rms\ton_screen\n'
for mag; do
    project="$name-mag$mag.caustic"
    caustic design "$picture" --source plane --mag "$mag" --out "$project" --quiet
    caustic render "$project" --rays 2e6 --json --quiet | python3 -c '
import json, sys
figures = json.load(sys.stdin)
print(sys.argv[1], format(figures["relative_rms"], ".3f"), format(figures["on_screen"], ".4f"), sep="\t")' "$mag"
done
