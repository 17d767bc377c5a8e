#!/bin/bash
# Installs the Debian packages of the foreign programs that the tests talk to, as far as they are missing, and
# with npm the clients of node/package.json, as they are locked there.
#
#   tests/peers/install.sh                every peer of the test suite
#   tests/peers/install.sh PACKAGE...     only these packages
#
# Exit 0: all are there. Exit 3: some are missing and may not be installed here (neither root nor
# passwordless sudo, or no apt-get); they are named on stderr. Any other exit: apt-get failed.
#
# Debian starts and enables the services of prometheus, snmpd, ser2net and others when it installs them. The tests only
# want the programs, and a second snmpd on a user's machine is a surprise. So starting is forbidden while
# apt runs (a policy-rc.d, Debian Policy 9.3.3.1, removed again; one that is already there is left
# alone), and units that came with this run are disabled afterwards. Services that were there before are
# not touched.
set -euo pipefail

# package, and the program or file that shows it is there
peers=(
  "mbpoll mbpoll"
  "snmp snmpwalk"
  "snmpd snmpd"
  "snmptrapd snmptrapd"
  "prometheus prometheus"
  "prometheus-snmp-exporter prometheus-snmp-exporter"
  "python3-yaml /usr/lib/python3/dist-packages/yaml"
  "smitools smilint"
  "socat socat"
  "ser2net ser2net"
  "curl curl"
  "openssl openssl"
  "iproute2 ip"
  "gcc cc"
  "libc6-dev /usr/include/stdio.h"
  "pkg-config pkg-config"
  "libmodbus-dev /usr/include/modbus/modbus.h"
  "nodejs node"
  "npm npm"
  "libsnmp-dev /usr/include/net-snmp/net-snmp-config.h"
  "faketime faketime"
  "systemd systemd-analyze"
  "udev udevadm"
  "umockdev umockdev-run"
  "podman podman"
  "crun crun"
  "catatonit catatonit"
  "debootstrap debootstrap"
)
policy=/usr/sbin/policy-rc.d
export PATH="$PATH:/usr/local/sbin:/usr/sbin:/sbin"

# is_there PACKAGE: by its program where we know one, so that a self-built peer counts too.
is_there() {
  local entry package probe
  for entry in "${peers[@]}"; do
    read -r package probe <<<"$entry"
    [[ $package == "$1" ]] || continue
    case $probe in
      /*) [[ -e $probe ]] ;;
      *) command -v "$probe" >/dev/null ;;
    esac
    return
  done
  [[ $(dpkg-query --show --showformat='${db:Status-Status}' "$1" 2>/dev/null) == installed ]]
}

missing_of() {
  local package
  for package in "$@"; do
    is_there "$package" || printf '%s\n' "$package"
  done
}

wanted=("$@")
if ((${#wanted[@]} == 0)); then
  wanted=("${peers[@]%% *}")
fi
# node_clients: what npm installs, when every peer is wanted; a lock makes room for one at a time.
node=$(dirname "$(readlink -f "$0")")/node
all=$((!$#))
node_clients() {
  ((all)) || return 0
  exec 9>"$node/.lock"
  flock 9
  [[ $node/node_modules/.package-lock.json -nt $node/package-lock.json ]] && return 0
  echo 'Installing Node clients'
  (cd "$node" && npm ci --omit=optional --ignore-scripts --no-audit --no-fund --loglevel=error >/dev/null) || {
    echo 'npm could not install the clients of tests/peers/node/package.json.' >&2
    exit 3
  }
}

mapfile -t missing < <(missing_of "${wanted[@]}")
if ((${#missing[@]} == 0)); then
  node_clients
  exit 0
fi

refuse() {
  printf 'Missing Debian packages: %s\n  %s\n  Install them yourself with: apt-get install --no-install-recommends %s\n' \
    "${missing[*]}" "$1" "${missing[*]}" >&2
  exit 3
}

command -v apt-get >/dev/null || refuse "There is no apt-get here."
root=()
if ((EUID != 0)); then
  if ! { command -v sudo >/dev/null && sudo -n true 2>/dev/null; }; then
    refuse "They cannot be installed for you: neither root nor sudo without a password."
  fi
  root=(sudo -n)
fi

printf 'Installing Debian packages: %s\n' "${missing[*]}"
log=$(mktemp)
placed_policy=
clean_up() {
  rm -f "$log"
  [[ -z $placed_policy ]] || "${root[@]}" rm -f "$policy"
}
trap clean_up EXIT
trap 'exit 130' INT TERM

if [[ ! -e $policy ]]; then
  placed_policy=yes
  printf '#!/bin/sh\n# Placed by tests/peers/install.sh for the time of one apt-get run.\nexit 101\n' |
    "${root[@]}" tee "$policy" >/dev/null
  "${root[@]}" chmod 755 "$policy"
fi

apt() {
  "${root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120 "$@" >"$log" 2>&1
}
have_lists() { compgen -G '/var/lib/apt/lists/*_Packages*' >/dev/null; }
install() { apt install --yes --no-install-recommends "${missing[@]}"; }

# Old package lists name versions that the mirror no longer has, so a failure is tried again with new ones.
if ! { have_lists && install; } && ! { apt update && install; }; then
  printf 'apt-get failed:\n' >&2
  tail -n 20 "$log" >&2
  exit 1
fi

if [[ -d /run/systemd/system ]]; then
  for package in "${missing[@]}"; do
    case $package in
      prometheus | prometheus-snmp-exporter | snmpd | ser2net) "${root[@]}" systemctl disable --now --quiet "$package.service" || true ;;
      snmptrapd) "${root[@]}" systemctl disable --now --quiet snmptrapd.service snmptrapd.socket || true ;;
      podman) "${root[@]}" systemctl disable --now --quiet podman.socket podman.service podman-auto-update.timer podman-restart.service || true ;;
    esac
  done
fi

mapfile -t missing < <(missing_of "${wanted[@]}")
((${#missing[@]} == 0)) || refuse "apt-get reported success, but they are still not found."
node_clients
