#!/bin/sh
# Removes the files that install.sh installed. See `sh systemd/uninstall.sh --help`.
set -eu
usage() {
  cat <<'HELP'
Remove everything that install.sh installed. Run `sh systemd/uninstall.sh` as root, or `make uninstall`.

  DESTDIR=/some/root  tree that phasestack was installed into
  PURGE=yes           also remove the configuration and the state

Example: PURGE=yes sh systemd/uninstall.sh
HELP
}
case "${1:-}" in
  '') ;;
  -h | --help) usage; exit 0 ;;
  *) echo "uninstall: unknown argument $1; see --help" >&2; exit 2 ;;
esac
DESTDIR=${DESTDIR:-}
if [ -z "$DESTDIR" ] && [ "$(id -u)" != 0 ]; then
  echo "uninstall: must be run as root unless DESTDIR is set" >&2
  exit 2
fi
live=no
if [ -z "$DESTDIR" ] && [ -d /run/systemd/system ]; then
  live=yes
  systemctl disable --now phasestack-page.service phasestack.service phasestack-x.service 2>/dev/null || true
fi
rm -f "$DESTDIR/usr/bin/phasestack" \
  "$DESTDIR/usr/lib/systemd/system/phasestack.service" \
  "$DESTDIR/usr/lib/systemd/system/phasestack-x.service" \
  "$DESTDIR/usr/lib/systemd/system/phasestack-page.service" \
  "$DESTDIR/usr/lib/systemd/user/phasestack.service" \
  "$DESTDIR/usr/lib/sysusers.d/phasestack.conf" \
  "$DESTDIR/usr/lib/tmpfiles.d/phasestack.conf" \
  "$DESTDIR/usr/lib/udev/rules.d/70-phasestack-sensors.rules"
rm -f /run/phasestack.failures /run/phasestack-x.failures
rm -rf "$DESTDIR/usr/lib/phasestack" "$DESTDIR/opt/phasestack" "$DESTDIR/usr/share/doc/phasestack" \
  "$DESTDIR/usr/lib/systemd/system/phasestack.service.d"
if [ "${PURGE:-no}" = yes ]; then
  rm -rf "$DESTDIR/etc/phasestack" "$DESTDIR/var/lib/phasestack"
fi
if [ "$live" = yes ]; then
  systemctl daemon-reload
  udevadm control --reload 2>/dev/null || true
fi
echo "phasestack was removed${DESTDIR:+ from $DESTDIR}"
for left in /etc/phasestack /var/lib/phasestack; do
  [ ! -e "$DESTDIR$left" ] || echo "  kept $DESTDIR$left; PURGE=yes removes it"
done
[ "$live" = no ] || ! id phasestack >/dev/null 2>&1 || echo "  kept the user and group phasestack; userdel phasestack removes them"
