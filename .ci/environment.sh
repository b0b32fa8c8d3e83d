# Sourced by `run` and `proofs`: a clean checkout of HEAD in a fresh environment, and ways to install into environments.
# Sets `work` (a folder, removed at the end), `pythons`, and `python`, the first of them; the working folder is the
# checkout, and its environment `$work/venv` is active.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
work=$(mktemp -d)
checks=  # the process that runs beside the others, while it runs
trap '[ -z "$checks" ] || kill "$checks" 2>/dev/null || true; rm -rf "$work"' EXIT
export PIP_DISABLE_PIP_VERSION_CHECK=1 SEALSCOPE_CACHE_DIR="$work/cache" UV_CACHE_DIR="$work/uv"
unset PYTHONDONTWRITEBYTECODE  # each of many processes would compile the same sources

# each Python that the project supports and this machine has, newest last
pythons=()
for version in 3.11 3.12 3.13 3.14; do
    for candidate in "python$version" "${PYENV_ROOT:-$HOME/.pyenv}"/versions/"$version".*/bin/python; do
        if "$candidate" -c "import sys, venv; sys.exit('%d.%d' % sys.version_info[:2] != '$version')" 2>/dev/null; then
            pythons+=("$candidate")
            break
        fi
    done
done
python=${pythons[0]}

git -C "$root" archive --format=tar HEAD | (mkdir -p "$work/checkout" && tar -x -C "$work/checkout")
# data that is not part of the repository, where this machine has it beside the checkout
if [ -d "$root/../shared" ]; then ln -s "$(cd "$root/../shared" && pwd)" "$work/shared"; fi
cd "$work/checkout"
"$python" -m venv "$work/venv"
. "$work/venv/bin/activate"

# install_system_packages: what some tests need of the system: a browser, a broker, a proxy, a database, a compiler for
# controllers; they skip where these cannot be installed
install_system_packages() {
    if ! command -v apt-get >/dev/null || [ "$(id -u)" != 0 ]; then return; fi
    local wanted=()
    command -v chromium >/dev/null || wanted+=(chromium)
    command -v mosquitto >/dev/null || wanted+=(mosquitto)
    command -v nginx >/dev/null || wanted+=(nginx)
    ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1 || wanted+=(postgresql)
    command -v arm-none-eabi-gcc >/dev/null || wanted+=(gcc-arm-none-eabi libnewlib-arm-none-eabi)
    if [ ${#wanted[@]} -gt 0 ]; then
        (apt-get install -qq -y "${wanted[@]}" || (apt-get update -qq && apt-get install -qq -y "${wanted[@]}")) \
            >/dev/null 2>&1 || true
    fi
}

# find_uv: from here on `install` takes uv, which shares what it downloads and builds between environments; where it
# reaches no index, whose settings are not pip's, pip goes on
fast=no
find_uv() {
    if pip install --quiet uv && uv venv --quiet --python "$python" "$work/probe" \
        && uv pip install --quiet --python "$work/probe/bin/python" wheel; then fast=yes; fi
    echo "installed by $([ $fast = yes ] && echo uv || echo pip)"
}

# install PYTHON ARGUMENT...: into the environment of that Python
install() {
    if [ $fast = yes ]; then uv pip install --quiet --python "$@"; else "$1" -m pip install --quiet "${@:2}"; fi
}

# install_third_decoders: decoders of third parties, which pin an older paho-mqtt
install_third_decoders() {
    pip install --quiet --no-deps pysparkplug mqtt-spb-wrapper
}

# show_checks: wait for the process `checks`, whose output goes to checks.txt, print that, and end with its status
show_checks() {
    local failed=0
    wait "$checks" || failed=1
    checks=
    cat "$work/checks.txt"
    exit "$failed"
}
