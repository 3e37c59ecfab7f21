#!/bin/sh
# One picture at several magnifications: designs each lens, retraces it, and prints a table.  Run again, it designs only what is new.
# Usage: magnifications.sh PICTURE [MAG ...]
set -eu
picture=${1:?usage: magnifications.sh PICTURE [MAG ...]}
shift
[ $# -gt 0 ] || set -- 1 3 5
name=$(basename "$picture" | sed 's/\.[^.]*$//')
printf 'mag\terror\tby\ton_screen\n'
for mag; do
    project="$name-mag$mag.caustic"
    caustic design "$picture" --source plane --mag "$mag" --out "$project" --quiet > /dev/null
    caustic render "$project" --rays 2e6 --json --quiet | python3 -c '
import json, sys
figures = json.load(sys.stdin)
light = figures["wave_on_screen" if figures["error_by"] == "waves" else "on_screen"]
print(sys.argv[1], format(figures["error"], ".3f"), figures["error_by"], format(light, ".4f"), sep="\t")' "$mag"
done
