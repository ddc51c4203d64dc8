#!/bin/sh
# Installs phasestack for the whole machine. See `sh systemd/install.sh --help`.
set -eu
usage() {
  cat <<'HELP'
Install phasestack system-wide. Run `sh systemd/install.sh` as root, or `make install`.

  DESTDIR=/some/root  install into this tree, as for a package, without changing this machine
  PYTHON=python3.11   Python interpreter to run phasestack with (3.11 or later)
  APP=no              install only the units, rules and configuration, not the program

Example: DESTDIR=/tmp/tree PYTHON=python3.12 sh systemd/install.sh
HELP
}
case "${1:-}" in
  '') ;;
  -h | --help) usage; exit 0 ;;
  *) echo "install: unknown argument $1; see --help" >&2; exit 2 ;;
esac
# The user of the service must be able to read the installed files.
umask 022
here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
source=$(dirname -- "$here")
DESTDIR=${DESTDIR:-}
python=$(command -v "${PYTHON:-python3}") || { echo "install: ${PYTHON:-python3}: not found" >&2; exit 2; }
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
  || { echo "install: $python: Python 3.11 or later is required" >&2; exit 2; }
if [ -z "$DESTDIR" ] && [ "$(id -u)" != 0 ]; then
  echo "install: must be run as root unless DESTDIR is set" >&2
  exit 2
fi

library=/opt/phasestack/lib
kept=$(mktemp -d)
trap 'rm -rf "$kept"' EXIT
live=no running=''
if [ -z "$DESTDIR" ] && [ -d /run/systemd/system ]; then
  live=yes
fi
# put MODE SOURCE TARGET installs a file. The file that it replaces is kept until the new version runs.
put() {
  [ ! -e "$DESTDIR$3" ] || install -D -m "$1" "$DESTDIR$3" "$kept/tree$3"
  case $2 in /*) from=$2 ;; *) from=$here/$2 ;; esac
  install -D -m "$1" "$from" "$DESTDIR$3"
}

if [ "${APP:-yes}" != no ]; then
  # An earlier installation may have made the folder readable only by root.
  install -d -m 755 "$DESTDIR/opt/phasestack"
  rm -rf "$DESTDIR$library.new"
  "$python" -m pip install --quiet --root-user-action=ignore --target "$DESTDIR$library.new" -r "$source/requirements/runtime.lock"
  # Install from a copy, because pip would also install deleted modules from a build folder that remains in the source.
  (cd "$source" && mkdir "$kept/source" && cp -r pyproject.toml README.md LICENSE THIRD_PARTY.md phasestack runtime calib model_export "$kept/source")
  "$python" -m pip install --quiet --root-user-action=ignore --no-deps --target "$DESTDIR$library.new" "$kept/source"
fi

# Stop the running services first, because they must not load modules of the new version.
if [ "$live" = yes ]; then
  for unit in phasestack-page phasestack phasestack-x; do
    case $(systemctl show --property=ActiveState --value "$unit") in
      inactive | failed) ;;
      *) running="$running $unit" ;;
    esac
  done
  # shellcheck disable=SC2086
  [ -z "$running" ] || systemctl stop $running
fi
if [ "${APP:-yes}" != no ]; then
  rm -rf "$DESTDIR$library.old"
  [ ! -e "$DESTDIR$library" ] || mv "$DESTDIR$library" "$DESTDIR$library.old"
  mv "$DESTDIR$library.new" "$DESTDIR$library"
fi
cat > "$kept/launcher" <<LAUNCHER
#!/bin/sh
export ORT_DISABLE_TELEMETRY=1
PYTHONPATH=$library exec $python -sP -c 'import sys; sys.argv[0] = "phasestack"; from runtime.cli import main; main()' "\$@"
LAUNCHER
put 755 "$kept/launcher" /usr/bin/phasestack

put 644 phasestack.service /usr/lib/systemd/system/phasestack.service
put 644 phasestack-x.service /usr/lib/systemd/system/phasestack-x.service
put 644 phasestack-page.service /usr/lib/systemd/system/phasestack-page.service
put 644 phasestack-user.service /usr/lib/systemd/user/phasestack.service
put 644 phasestack.sysusers.conf /usr/lib/sysusers.d/phasestack.conf
put 644 phasestack.tmpfiles.conf /usr/lib/tmpfiles.d/phasestack.conf
put 644 70-phasestack-sensors.rules /usr/lib/udev/rules.d/70-phasestack-sensors.rules
put 755 x-authority /usr/lib/phasestack/x-authority
put 755 back-off /usr/lib/phasestack/back-off
put 644 ../docs/operation.md /usr/share/doc/phasestack/operation.md
put 644 ../docs/install.md /usr/share/doc/phasestack/install.md
put 644 ../docs/planning.md /usr/share/doc/phasestack/planning.md
put 644 ../THIRD_PARTY.md /usr/share/doc/phasestack/THIRD_PARTY.md
# The operator's configuration is never replaced.
[ -e "$DESTDIR/etc/phasestack/phasestack.toml" ] || put 644 phasestack.toml /etc/phasestack/phasestack.toml

if [ "$live" = yes ]; then
  systemd-sysusers
  systemd-tmpfiles --create phasestack.conf
  { udevadm control --reload && udevadm trigger --subsystem-match=usb; } || echo "install: udev is not running, so its rules were not reloaded"
  systemctl daemon-reload
  # shellcheck disable=SC2086
  if [ -n "$running" ] && ! systemctl start $running; then
    echo "install: the new version failed to start; restoring the previous version. Reason:" >&2
    systemctl show phasestack --property=StatusText --value >&2
    systemctl stop $running 2>/dev/null || true
    rm -rf "$library.new"
    [ ! -e "$library.old" ] || { mv "$library" "$library.new" && mv "$library.old" "$library" && rm -rf "$library.new"; }
    cp -a "$kept/tree/." /
    systemctl daemon-reload
    systemctl start $running
    exit 1
  fi
fi
rm -rf "$DESTDIR$library.old"
cat <<NEXT
phasestack is installed${DESTDIR:+ in $DESTDIR}. Next steps:
  1. run phasestack setup (docs/setup.md), or edit /etc/phasestack/phasestack.toml with the help of phasestack identify
     and phasestack doctor
  2. run systemctl enable --now phasestack
  3. run systemctl enable --now phasestack-page to serve the operator's page at http://localhost:8717
NEXT
