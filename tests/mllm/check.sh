#!/usr/bin/env bash
# Checks the refiner mllm against a real llama-server with a tiny vision model of random weights: what the model says is
# noise, but the server accepts or refuses requests as a real one does, and follows the schema of an answer.
#
#     check.sh BINARY VENV
#
# VENV is the folder of a Python virtual environment (requirements.txt); it is created if missing. After that, a run
# takes about half a minute. Exits with 1 if anything fails.
set -euo pipefail
# shellcheck source-path=SCRIPTDIR source=../server.sh
. "$(dirname "$0")/../server.sh"
arguments "$0" "$@"
environment "$venv" requirements.txt

"$venv/bin/python" tiny_model.py "$scratch"
port=$(free_port "$venv")
llama=$(find "$venv/bin" -name 'llama-server*' | head -1)
"$llama" --model "$scratch/tiny.gguf" --mmproj "$scratch/tiny-pictures.gguf" --host 127.0.0.1 --port "$port" \
    --ctx-size 16384 --parallel 1 --threads 1 > "$scratch/llama" 2>&1 &
llama=$!
python3 ../deploy/outside.py "$scratch/outside" &
outside=$!
trap 'kill "$llama" "$outside" 2> /dev/null || true; finish' EXIT
for _ in $(seq 300); do
    if curl --silent --fail "http://127.0.0.1:$port/health" > "$scratch/health" && [ -s "$scratch/outside" ]; then break; fi
    if ! kill -0 "$llama" 2> /dev/null; then
        cat "$scratch/llama" >&2
        exit 1
    fi
    sleep 0.1
done

town "$binary" 6
cp -r "$scratch/town/data" "$scratch/data"
export WHEREABOUTS_MODEL__NAME=xfeat WHEREABOUTS_REFINE__REFINER=mllm WHEREABOUTS_MLLM__MAX_TOKENS=1000
LLAMA=http://127.0.0.1:$port/v1 OUTSIDE=$(cat "$scratch/outside")/v1
export LLAMA OUTSIDE BINARY=$binary SCRATCH=$scratch PYTHONDONTWRITEBYTECODE=1
# The model that describes says something sensible; the one that ranks is real.
WHEREABOUTS_MLLM__BASE_URL=$OUTSIDE WHEREABOUTS_MLLM__REASON_BASE_URL=$LLAMA serve "$binary"
URL=$url timeout 240 "$venv/bin/python" -m unittest
