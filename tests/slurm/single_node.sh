#!/usr/bin/env bash
# A SLURM cluster of this one machine, from Debian's packages, for as long as a command runs:
#
#   apt-get install --no-install-recommends slurmctld slurmd slurm-client munge      (once, as root)
#   tests/slurm/single_node.sh python -m data_prep category=hydrant launcher=slurm launcher.partition=here
#
# Needs root. Everything it writes lies in a temporary folder that is removed afterwards, but for
# munge's key in /etc/munge, which is made where there is none.
set -euo pipefail
state=$(mktemp -d)
key=/etc/munge/munge.key
[ -f "$key" ] || { dd if=/dev/urandom of="$key" bs=1024 count=1 status=none; chown munge: "$key"; chmod 400 "$key"; }
mkdir -p /run/munge && chown munge: /run/munge && chmod 755 /run/munge
mkdir -p "$state/ctld" "$state/d"
node=$(hostname -s)
cat > "$state/slurm.conf" <<CONF
ClusterName=here
SlurmctldHost=$node(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
CryptoType=crypto/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
StateSaveLocation=$state/ctld
SlurmdSpoolDir=$state/d
SlurmctldPidFile=$state/slurmctld.pid
SlurmdPidFile=$state/slurmd.pid
SlurmctldLogFile=$state/slurmctld.log
SlurmdLogFile=$state/slurmd.log
NodeName=$node NodeAddr=127.0.0.1 CPUs=$(nproc --all) RealMemory=$(( $(awk '/MemTotal/ {print $2}' /proc/meminfo) / 1024 - 512 )) State=UNKNOWN
PartitionName=here Nodes=$node Default=YES MaxTime=INFINITE State=UP
CONF
export SLURM_CONF=$state/slurm.conf
runuser -u munge -- /usr/sbin/munged --foreground >"$state/munged.out" 2>&1 & munge_pid=$!
for _ in $(seq 50); do munge -n >/dev/null 2>&1 && break; sleep 0.2; done
/usr/sbin/slurmctld -D >"$state/slurmctld.out" 2>&1 & controller_pid=$!
/usr/sbin/slurmd -D >"$state/slurmd.out" 2>&1 & daemon_pid=$!
stop() {
    status=$?
    if [ $status -ne 0 ]; then tail -n 20 "$state"/slurm*.log >&2 || true; fi
    kill $daemon_pid $controller_pid $munge_pid 2>/dev/null || true
    wait 2>/dev/null || true
    rm -rf "$state"
    exit $status
}
trap stop EXIT
for _ in $(seq 100); do
    [ "$(sinfo --noheader --format=%t 2>/dev/null)" = idle ] && break
    sleep 0.3
done
sinfo
"$@"
