#!/usr/bin/env bash
# Rewrites python-requirements.txt: the packages that deploy/models/make_xfeat.py needs, each with
# the hashes of its wheels for every Python version and platform that assets.sh supports.
# For maintainers, after changing a version below.
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
python=${PYTHON:-python3}

pythons=(3.10 3.11 3.12 3.13 3.14)
old_numpy='numpy==2.2.6'  # the last for Python 3.10
new_numpy='numpy==2.4.6'  # the last for Python 3.11
rest=(onnx==1.23.2 protobuf==7.36.2 ml_dtypes==0.6.0 typing_extensions==4.16.0)
platforms=(
    'manylinux_2_28_x86_64 manylinux2014_x86_64'
    'manylinux_2_28_aarch64 manylinux2014_aarch64'
    'macosx_14_0_arm64'
)

wheels=$(mktemp -d)
trap 'rm -rf "$wheels"' EXIT

for version in "${pythons[@]}"; do
    numpy=$new_numpy
    if [ "$version" = 3.10 ]; then numpy=$old_numpy; fi
    for platform in "${platforms[@]}"; do
        options=()
        for tag in $platform; do options+=(--platform "$tag"); done
        "$python" -m pip download --quiet --disable-pip-version-check --no-deps \
            --only-binary=:all: --implementation cp --python-version "$version" "${options[@]}" \
            --dest "$wheels" "$numpy" "${rest[@]}"
    done
done

# Prints the line for $1, a pinned package, with an optional marker $2.
line() {
    printf '%s%s' "$1" "${2:+ ; $2}"
    local file
    for file in "$wheels/${1%%==*}-${1##*==}"-*.whl; do
        printf ' \\\n    --hash=sha256:%s' "$(sha256sum "$file" | cut -d ' ' -f 1)"
    done
    printf '\n'
}

{
    printf '# Written by lock-python.sh. Python %s; ' "${pythons[*]}"
    printf 'Linux x86_64 and aarch64 (glibc 2.28), macOS 14 arm64.\n'
    line "$old_numpy" 'python_version < "3.11"'
    line "$new_numpy" 'python_version >= "3.11"'
    for package in "${rest[@]}"; do line "$package"; done
} >"$here/python-requirements.txt.new"
mv "$here/python-requirements.txt.new" "$here/python-requirements.txt"
