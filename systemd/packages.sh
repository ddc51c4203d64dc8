#!/bin/sh
# Installs the Debian packages that a runtime built from source needs, or prints the command if the user is not root.
# The argument `test` adds the packages for the tests, and `slow` also those for the slow tests.
set -u
runtime="g++ libegl1 libgl1-mesa-dri libgles2 libgl1 libusb-1.0-0 libopenni2-0"
testing="xvfb xserver-xorg-core xserver-xorg-video-dummy x11-xserver-utils x11-apps xdotool imagemagick chromium systemd udev"
testing="$testing libxcb-composite0 libxcb-res0"
slow="debootstrap systemd-container buildah e2fsprogs"  # tests of a booted system, of the image and of a power cut
case ${1:-} in
  test) wanted="$runtime $testing" ;;
  slow) wanted="$runtime $testing $slow" ;;
  *) wanted=$runtime ;;
esac
command -v dpkg-query >/dev/null || { echo "This is not Debian; install the equivalents of: $wanted"; exit 0; }
missing=""
for name in $wanted; do
  dpkg-query -W -f='${Status}' "$name" 2>/dev/null | grep -q "install ok installed" || missing="$missing $name"
done
[ -z "$missing" ] && exit 0
if [ "$(id -u)" != 0 ]; then
  echo "Packages are missing; run as root: apt-get install$missing"
  exit 0
fi
echo "Installing Debian packages (minutes on a slow line):$missing"
export DEBIAN_FRONTEND=noninteractive
# shellcheck disable=SC2086
{ apt-get update -qq && apt-get install -y -qq --no-install-recommends $missing; } >/dev/null \
  || echo "The packages could not be installed; run: apt-get install$missing"
