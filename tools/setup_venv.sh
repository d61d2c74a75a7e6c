#!/usr/bin/env bash
# Makes a Python environment with what builds snh-slam: system packages, the environment itself, torch, build tools.
# What is there already is kept. Called by make, with the folder of the environment as argument.
#   PYTHON  interpreter (default python3)
#   TORCH   what pip installs as torch, with options if need be
set -euo pipefail
venv=$1
python=${PYTHON:-python3}
torch_version=2.13.0

stop() {
  echo "snh-slam: $*" >&2
  exit 1
}

# Debian's names of what is not there: compiler, headers, the shared libraries that Open3D loads.
missing_system_packages() {
  local include library libraries
  command -v "${CXX:-c++}" >/dev/null || echo g++
  include=$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
  [[ -e $include/Python.h ]] || echo python3-dev
  "$python" -c 'import ensurepip' 2>/dev/null || echo python3-venv
  [[ -e /usr/include/eigen3/Eigen/Core || -e /usr/local/include/eigen3/Eigen/Core ||
    -n ${CMAKE_ARGS:-}${CMAKE_PREFIX_PATH:-}${Eigen3_DIR:-}${Eigen3_ROOT:-} ]] || echo libeigen3-dev
  libraries=$(PATH=$PATH:/sbin:/usr/sbin ldconfig -p)
  for library in libusb-1.0.so.0=libusb-1.0-0 libGL.so.1=libgl1 libEGL.so.1=libegl1 libgomp.so.1=libgomp1 \
    libX11.so.6=libx11-6; do
    [[ $libraries == *"${library%=*} "* ]] || echo "${library#*=}"
  done
}

install_system_packages() {
  local packages=("$@") sudo=()
  local command="apt-get update && sudo apt-get install ${packages[*]}"
  command -v apt-get >/dev/null || stop "missing, by their Debian names: ${packages[*]}; install them with your package manager"
  if ((EUID != 0)); then
    sudo -n true 2>/dev/null || stop "missing system packages; run: sudo $command"
    sudo=(sudo -n)
  fi
  echo "== system packages: ${packages[*]}"
  "${sudo[@]}" apt-get -qq update
  DEBIAN_FRONTEND=noninteractive "${sudo[@]}" apt-get -qq install --no-install-recommends "${packages[@]}" >/dev/null
}

torch_is_usable() {
  "$venv/bin/python" -c 'import torch; assert [int(n) for n in torch.__version__.split(".")[:2]] >= [2, 10]' 2>/dev/null
}

install_torch() {
  local pip=("$venv/bin/pip" install --quiet)
  echo "== torch into $venv (200 MB without CUDA, 3 GB with)"
  if [[ -n ${TORCH:-} ]]; then
    # shellcheck disable=SC2086  # TORCH may carry options of pip
    "${pip[@]}" $TORCH
  elif command -v nvidia-smi >/dev/null; then
    "${pip[@]}" "torch==$torch_version"
  else
    # The CPU build from the configured index, else from PyTorch's own, else whatever the index has.
    "${pip[@]}" "torch==$torch_version+cpu" 2>/dev/null ||
      "${pip[@]}" --retries 1 --index-url https://download.pytorch.org/whl/cpu "torch==$torch_version" ||
      "${pip[@]}" "torch==$torch_version"
  fi
}

command -v "$python" >/dev/null || stop "the interpreter '$python' is missing; run: sudo apt-get install python3 python3-venv"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
  stop "$("$python" --version) is too old; run make with PYTHON=python3.10 or newer"
mapfile -t packages < <(missing_system_packages)
((${#packages[@]} == 0)) || install_system_packages "${packages[@]}"

if [[ ! -x $venv/bin/pip ]]; then
  echo "== Python environment $venv"
  "$python" -m venv --clear "$venv"
fi
torch_is_usable || install_torch
echo "== build tools into $venv"
mapfile -t requirements < <(sed -n 's/^requires = \[\(.*\)\]$/\1/p' pyproject.toml | tr -d '" ' | tr ',' '\n')
"$venv/bin/pip" install --quiet "${requirements[@]}" numpy  # without numpy, importing torch warns
