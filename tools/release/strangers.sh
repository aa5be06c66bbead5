#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Follow README's section Install word for word on fresh machines: minimal Debians without Node.js and fonts, as root and
# as a new user, with and without a compiler. Prints a table; needs root, debootstrap and some minutes for each machine.
#
#   tools/release/strangers.sh [SUITE[:USER[:COMPILER]]...]    such as trixie, sid:root:none, bookworm:user:g++
#
# What is committed is tested. Systems and logs are kept in out/strangers; two calls may run side by side.
set -euo pipefail
cd "$(dirname "$0")/../.."
work=$PWD/out/strangers
packages=ca-certificates,git,make,python3,python3-venv # of Debian's, what README asks for, and certificates
certificates=/etc/ssl/certs/ca-certificates.crt        # a network may have its own
mkdir -p "$work/logs"

# system SUITE COMPILER: make the system once, and print its folder.
system() {
    local folder=$work/$1-$2 extra=
    [ "$2" = none ] || extra=,$2
    if [ ! -e "$folder.done" ]; then
        rm -rf "$folder"
        PATH=$PATH:/usr/sbin debootstrap --variant=minbase --include="$packages$extra" "$1" "$folder" \
            >"$work/logs/debootstrap-$1-$2.log" 2>&1
        cp /etc/resolv.conf "$folder/etc/"
        [ ! -e "$certificates" ] || cp "$certificates" "$folder$certificates"
        printf '[global]\ncert = %s\n' "$certificates" >"$folder/etc/pip.conf"
        touch "$folder.done"
    fi
    echo "$folder"
}

# The lines of README's first block after "## Install".
install_lines() {
    awk '/^## Install/ { found = 1 } found && /^```$/ { exit } inside; found && /^```sh/ { inside = 1 }' README.md
}

# follow SUITE USER COMPILER: run the lines in a copy of the system, print a row of the table, and count failures.
follow() {
    local root=$work/machine-$1-$2-$3 home=/root log=$work/logs/$1-$2-$3.log lines base row
    rm -rf "$root"
    base=$(system "$1" "$3")
    cp -a --reflink=auto "$base" "$root"
    if [ "$2" != root ]; then
        chroot "$root" useradd --create-home "$2"
        home=/home/$2
    fi
    git clone --quiet --no-hardlinks . "$root$home/csplat"
    lines=$root$home/lines.sh
    {
        echo 'cd ~/csplat'
        install_lines | while IFS= read -r line; do
            printf 'eval %q; noted $? %q\n' "$line" "${line%%  *#*}"
        done
    } >"$lines"
    cat >"$root$home/follow.sh" <<'SCRIPT'
noted() {
    local status=$1 cpu
    times >/tmp/times
    cpu=$(awk -F'[ms ]+' '{ total += 60 * $1 + $2 + 60 * $3 + $4 } END { printf "%d", total }' /tmp/times)
    [ "$status" = 0 ] && status=ok || status=FAILED
    printf '%s (%d CPU s)\t' "$status" $((cpu - before)) >>/tmp/row
    before=$cpu
}
before=0
. ~/lines.sh
SCRIPT
    chroot "$root" chown -R "$2": "$home"
    unshare --mount --pid --fork --kill-child bash -euc '
        mount -t proc proc "$1/proc"
        mount -t tmpfs -o mode=1777 tmpfs "$1/dev/shm"
        mount -t devpts -o newinstance,ptmxmode=0666 devpts "$1/dev/pts"
        exec chroot "$1" runuser -u "$2" -- env -i HOME="$3" PATH=/usr/local/bin:/usr/bin:/bin bash "$3/follow.sh"
    ' - "$root" "$2" "$home" </dev/null >"$log" 2>&1 || true
    row=$(cat "$root/tmp/row")
    printf '%s\t%s\t%s\t%s\t%s\n' "$1" "$(chroot "$root" python3 --version)" "$2" "$3" "$row"
    case $row in *FAILED*) failures=$((failures + 1)) ;; esac
    rm -rf "$root"
}

[ $# -gt 0 ] || set -- bookworm trixie sid
failures=0
printf 'Debian\tPython\tuser\tcompiler\t'
install_lines | sed -E 's/ {2,}#.*//' | paste -sd '\t'
for machine; do
    IFS=: read -r suite user compiler <<<"$machine"
    for user in ${user:-root user}; do
        for compiler in ${compiler:-none g++}; do
            follow "$suite" "$user" "$compiler"
        done
    done
done
[ $failures = 0 ]
