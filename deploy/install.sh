#!/bin/bash
# Installs this clone as a service on this machine, upgrades it, takes an upgrade back, removes it. As root:
#
#   deploy/install.sh                  install, or upgrade what is installed; run it again as often as you like
#   deploy/install.sh --wheels DIR     the same without a network: DIR holds what `make wheels` made
#   deploy/install.sh rollback         back to the release before the last upgrade
#   deploy/install.sh remove           remove it; configuration and state_dir stay
#   deploy/install.sh remove --purge   remove these too
#
# Each release has a folder of its own under /opt/prostar-gateway/releases; `current` points to the one in use, so a
# change of release is one rename. A release that refuses your configuration is not switched to, and one that does not
# start is switched back. Your configuration is never changed. DESTDIR=DIR puts everything below DIR (tests, images).
set -euo pipefail
umask 022  # the service is not root, and has to read what root puts into place

clone=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
root=${DESTDIR:-}
home=$root/opt/prostar-gateway
config=$root/etc/prostar-gateway/site.toml
unit=prostar-gateway.service
placed=(
  "deploy/systemd/prostar-gateway.service /etc/systemd/system/prostar-gateway.service"
  "deploy/systemd/sysusers.conf /etc/sysusers.d/prostar-gateway.conf"
  "deploy/systemd/modules-load.conf /etc/modules-load.d/prostar-gateway.conf"
  "deploy/udev/99-prostar-gateway.rules /etc/udev/rules.d/99-prostar-gateway.rules"
)

fail() {
  printf 'install.sh: %s\n' "$*" >&2
  exit 1
}

# has_systemd: whether there is a systemd to be told of changes.
has_systemd() { [[ -z $root && -d /run/systemd/system ]]; }

# point NAME RELEASE: make the link NAME in one step, so that it is never missing.
point() {
  ln -sfn "releases/$(basename "$2")" "$home/.$1"
  mv -T "$home/.$1" "$home/$1"
}

# release NAME: the folder that a link names; nothing when there is none.
release() { [[ ! -L $home/$1 ]] || readlink -f "$home/$1"; }

# find_python: python3.11, say, and not python3, which is another one after an upgrade of Debian and has no libraries then.
find_python() {
  local candidate
  for candidate in ${PYTHON:-python3 python3.11 python3.12 python3.13 python3.14}; do
    if "$candidate" -c 'import sys, ensurepip, venv; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
      "$candidate" -c 'import os, sys; print(os.path.realpath(sys.executable))'
      return
    fi
  done
  fail 'there is no Python 3.11 or newer that can make environments (apt-get install python3-venv)'
}

# make_release FOLDER WHEELS: an environment with the locked versions, hashes checked, and what goes with it.
make_release() {
  local python pip=()
  python=$(find_python)
  "$python" -m venv "$1"
  pip=("$1/bin/python" -m pip --disable-pip-version-check --quiet --quiet install)
  [[ -z $2 ]] || pip+=(--no-index --find-links "$2")
  "${pip[@]}" --require-hashes --requirement "$clone/requirements.txt"
  # Built from a copy: the clone may belong to somebody else and is left as it is.
  local source
  source=$(mktemp -d)
  cp -r "$clone/pyproject.toml" "$clone/README.md" "$clone/LICENSE" "$clone/gateway" "$source"
  "${pip[@]}" --no-deps --no-build-isolation "$source" || { rm -rf "$source"; return 1; }
  rm -rf "$source"
  mkdir -p "$1/share/prostar-gateway"
  cp -r "$clone"/{LICENSE,CHANGELOG.md,config,deploy,docs,mibs} "$1/share/prostar-gateway"
  "$1/bin/prostar-gateway" --version >/dev/null
}

place_files() {
  local entry from to
  for entry in "${placed[@]}"; do
    read -r from to <<<"$entry"
    install -D -m 644 "$1/share/prostar-gateway/$from" "$root$to"
  done
  mkdir -p "$root/usr/local/bin"
  ln -sfn "$home/current/bin/prostar-gateway" "$root/usr/local/bin/prostar-gateway"
  [[ -e $config ]] || install -D -m 644 "$1/share/prostar-gateway/config/minimal.toml" "$config"
  has_systemd || return 0
  systemd-sysusers /etc/sysusers.d/prostar-gateway.conf
  systemctl daemon-reload
  # Where there are no such modules (containers, drivers built in) there is nothing to load.
  systemctl restart systemd-modules-load.service 2>/dev/null || true
  if command -v udevadm >/dev/null && udevadm control --reload 2>/dev/null; then
    udevadm trigger --subsystem-match=usb --subsystem-match=usb-serial --subsystem-match=tty || true
  fi
}

# restart: false when the service was running and does not start any more.
restart() { ! has_systemd || systemctl try-restart "$unit"; }

install_release() {
  local wheels=$1 before older version new
  before=$(release current) older=$(release previous)
  version=$(sed -n 's/^version = "\(.*\)"$/\1/p' "$clone/pyproject.toml")
  mkdir -p "$home/releases"
  new=$home/releases/$version-$(date -u +%Y%m%dT%H%M%S)
  [[ ! -e $new ]] || fail "$new is there already; wait a second"
  # shellcheck disable=SC2064 # the folder of now
  trap "rm -rf '$new'; echo 'install.sh: no release was made; nothing was changed' >&2" EXIT
  make_release "$new" "$wheels"
  if [[ -n $before && -e $config ]]; then
    "$new/bin/prostar-gateway" check-config -c "$config" >/dev/null ||
      fail "release $version refuses $config"
  fi
  trap - EXIT
  [[ -z $before ]] || point previous "$before"
  point current "$new"
  place_files "$new"
  if ! restart; then
    [[ -n $before ]] || fail "the service does not start: journalctl -u $unit"
    point current "$before"
    if [[ -n $older ]]; then point previous "$older"; else rm -f "$home/previous"; fi
    place_files "$before"
    restart || true
    rm -rf "$new"
    fail "release $version does not start, so $(basename "$before") is in use again: journalctl -u $unit"
  fi
  local each
  for each in "$home"/releases/*; do
    [[ $each == "$new" || $each == "$before" ]] || rm -rf "$each"
  done
  echo "installed: $("$home/current/bin/prostar-gateway" --version) in $new"
  [[ -n $before ]] || printf '%s\n' "next: edit $config, then" \
    "  prostar-gateway check-config -c $config" "  systemctl enable --now prostar-gateway"
}

rollback() {
  local now before
  now=$(release current) before=$(release previous)
  [[ -n $before && -d $before ]] || fail 'there is no earlier release'
  "$before/bin/prostar-gateway" --version >/dev/null 2>&1 ||
    fail "$(basename "$before") does not run here any more (its Python is gone?); nothing was changed"
  point current "$before"
  point previous "$now"
  place_files "$before"
  restart || fail "the service does not start: journalctl -u $unit"
  echo "in use: $("$home/current/bin/prostar-gateway" --version) in $before"
}

remove() {
  local entry from to
  ! has_systemd || systemctl disable --now "$unit" 2>/dev/null || true
  for entry in "${placed[@]}"; do
    read -r from to <<<"$entry"
    rm -f "$root$to"
  done
  rm -f "$root/usr/local/bin/prostar-gateway"
  rm -rf "$home"
  if [[ ${1:-} == --purge ]]; then
    rm -rf "$root/etc/prostar-gateway" "$root/etc/systemd/system/$unit.d" \
      "$root/var/lib/prostar-gateway" "$root/var/lib/private/prostar-gateway"
  fi
  if has_systemd; then
    systemctl daemon-reload
    systemctl reset-failed "$unit" 2>/dev/null || true
    [[ ${1:-} != --purge ]] || groupdel prostar-secrets 2>/dev/null || true
    ! command -v udevadm >/dev/null || udevadm control --reload 2>/dev/null || true
  fi
  echo 'removed'
}

if [[ -z $root && $EUID -ne 0 ]]; then
  fail 'this takes root'
fi
case ${1:-} in
  '') install_release '' ;;
  --wheels)
    [[ -n ${2:-} && -d $2 ]] || fail '--wheels takes a folder'
    install_release "$(cd "$2" && pwd)"
    ;;
  rollback) rollback ;;
  remove) remove "${2:-}" ;;
  *)
    sed -n '2,/^set /{/^#/s/^# \{0,1\}//p}' "${BASH_SOURCE[0]}" >&2
    exit 2
    ;;
esac
