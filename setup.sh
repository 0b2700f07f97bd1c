#!/usr/bin/env bash
# Sets up all that mi_prt needs: .venv with the package and its tests, an LLVM that Dr.Jit can use, and a library
# that draws without a screen (OSMesa, EGL or both). `make demo` and `make test` call it when needed.
#
# System packages are installed with apt, and only those that are missing; elsewhere, or without the right to, it says
# what to type. It can be interrupted and run again: the stamp that make looks for is written last.
#
#   PYTHON=/path/to/python3.12 ./setup.sh    use this interpreter (3.11 to 3.14)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

venv=.venv
pythons=(python3 python3.13 python3.12 python3.14 python3.11)
llvms=(libllvm22 libllvm21 libllvm20 libllvm19 libllvm18 libllvm17t64 libllvm17)
egl=(libegl1 libopengl0 libgl1-mesa-dri)
installer=unknown
updated=no

say() { printf 'setup: %s\n' "$*" >&2; }
fail() { say "$@"; exit 1; }

# Whether packages may be installed: as root, by passwordless sudo, or where someone is there to give the password.
can_install() {
    if [ "$installer" = unknown ]; then
        installer=nobody
        if ! command -v apt-get >/dev/null; then
            say "this system has no apt-get: packages must be installed by hand"
        elif [ "$(id -u)" -eq 0 ]; then
            installer=root
        elif command -v sudo >/dev/null; then
            if sudo -n true 2>/dev/null || { [ -t 0 ] && say "sudo is needed to install packages" && sudo -v; }; then
                installer=sudo
            fi
        fi
    fi
    [ "$installer" != nobody ]
}

apt() {
    local prefix=()
    [ "$installer" = root ] || prefix=(sudo)
    "${prefix[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=300 "$@" >/dev/null
}

apt_offers() {
    local version
    version=$(LC_ALL=C apt-cache policy "$1" | sed -n 's/ *Candidate: //p')
    [ -n "$version" ] && [ "$version" != "(none)" ]
}

# Prints those of the packages that apt offers.
apt_offered() {
    local package
    for package; do
        if apt_offers "$package"; then
            echo "$package"
        fi
    done
}

apt_update() {
    if [ "$updated" = no ]; then
        updated=yes
        say "updating apt's lists"
        apt update
    fi
}

# Installs the first (or all) of the packages that apt offers. Lists that were never made offer nothing, and old ones
# name files that are gone: both are tried again with new lists.
apt_install() {
    local which=$1 offered
    shift
    can_install || return 1
    [ -n "$(apt_offered "$@")" ] || apt_update || return 1
    mapfile -t offered < <(apt_offered "$@")
    [ "${#offered[@]}" -gt 0 ] || return 1
    [ "$which" = all ] || offered=("${offered[0]}")
    say "installing ${offered[*]}"
    apt install -y --no-install-recommends "${offered[@]}" && return
    apt_update && apt install -y --no-install-recommends "${offered[@]}"
}

# Whether a Python is one that Mitsuba is built for.
usable_python() { "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' >/dev/null 2>&1; }

find_python() {
    local python
    for python in ${PYTHON:-"${pythons[@]}"}; do
        if usable_python "$python"; then
            echo "$python"
            return
        fi
    done
    return 1
}

has_venv() { "$1" -c 'import venv, ensurepip' >/dev/null 2>&1; }

make_venv() {
    local python name
    if ! python=$(find_python); then
        [ -z "${PYTHON:-}" ] || fail "PYTHON=$PYTHON is not a Python from 3.11 to 3.14"
        say "no Python from 3.11 to 3.14 is here ($(python3 --version 2>/dev/null || echo "no python3 at all"))"
        apt_install first python3.13 python3.12 python3.11 || true
        python=$(find_python) || fail "install Python 3.11 to 3.14, for example with" \
            "\`sudo apt-get install python3.11 python3.11-venv\` or from https://www.python.org/downloads," \
            "then run make again, with PYTHON=/path/to/it if it is not on PATH"
    fi
    if ! has_venv "$python"; then
        name=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
        say "$python lacks its venv module"
        apt_install first "$name" || true
        has_venv "$python" || fail "type \`sudo apt-get install $name\` (the name may differ on your system)," \
            "then run make again"
    fi
    say "creating $venv with $("$python" --version)"
    "$python" -m venv --clear "$venv"
}

# Whether mi_prt's own examination finds the rays or the raster in order; keeps what it advises if not.
works() {
    advice=$("$venv/bin/python" - "$1" 2>&1 <<'EOF'
import sys
from mi_prt.system import doctor

check = getattr(doctor, f"check_{sys.argv[1]}")()
if check.status == "fault":
    sys.exit(f"{check.value}\nsetup: {check.remedy}")
EOF
    )
}

loads() { "$venv/bin/python" -c "import ctypes; ctypes.CDLL('$1')" 2>/dev/null; }

# Slim images lack libatomic, which Dr.Jit needs. A library that the user chose by a variable is not ours to replace.
provide_rays() {
    works rays && return
    if [ "$(uname)" = Linux ] && ! loads libatomic.so.1; then
        advice="Dr.Jit needs libatomic.so.1: type \`sudo apt-get install libatomic1\` (elsewhere libatomic, gcc-libs)"
        apt_install first libatomic1 || return 1
        works rays && return
    fi
    [ -z "${DRJIT_LIBLLVM_PATH:-}" ] && can_install || return 1
    if ! apt_install first "${llvms[@]}"; then
        advice+=$'\n'"setup: if this release has none of them, add LLVM's own packages first: https://apt.llvm.org"
        return 1
    fi
    works rays
}

has_library() { "$venv/bin/python" -c "import sys; from ctypes.util import find_library; sys.exit(not find_library('$1'))"; }

asks_nobody() { [ "$(id -u)" -eq 0 ] || sudo -n true 2>/dev/null; }

# One of both is enough to go on. The other one is installed as well where nobody must be asked for a password: the
# tests compare them.
provide_raster() {
    if [ -z "${PYOPENGL_PLATFORM:-}" ]; then
        works raster || apt_install first libosmesa6 || true
        works raster || apt_install all "${egl[@]}" || true
        if asks_nobody; then
            has_library OSMesa || apt_install first libosmesa6 || true
            has_library EGL || apt_install all "${egl[@]}" || true
        fi
    fi
    works raster
}

rm -f "$venv/.ready"
if ! { usable_python "$venv/bin/python" && "$venv/bin/python" -m pip --version >/dev/null 2>&1; }; then
    make_venv
fi
say "installing the Python packages into $venv (the first time this takes a minute or two)"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check -e '.[test,dev]'
provide_rays || fail "$advice"$'\n'"setup: do this, then run make again: Mitsuba cannot render yet"
provide_raster || fail "$advice"$'\n'"setup: do this, then run make again: nothing draws without a screen yet"
pwd -P >"$venv/.ready"
say "done"
