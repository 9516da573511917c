#!/usr/bin/env bash
# A SLURM cluster on this one machine, from Debian's packages, for as long as a command runs:
#
#   apt-get install --no-install-recommends slurmctld slurmd slurm-client munge      (once, as root)
#   tests/slurm/cluster.sh 1 python -m data_prep category=hydrant launcher=slurm launcher.partition=here
#
# The first argument is the number of nodes, each a slurmd of its own with its share of the cores.
# Needs root. Everything it writes lies in a temporary folder that is removed afterwards, but for
# munge's key in /etc/munge, which is made where there is none.
set -euo pipefail
nodes=$1; shift
state=$(mktemp -d)
key=/etc/munge/munge.key
[ -f "$key" ] || { dd if=/dev/urandom of="$key" bs=1024 count=1 status=none; chown munge: "$key"; chmod 400 "$key"; }
mkdir -p /run/munge && chown munge: /run/munge && chmod 755 /run/munge
mkdir -p "$state/ctld"
host=$(hostname -s)
cores=$(( $(nproc --all) / nodes )); memory=$(( ($(awk '/MemTotal/ {print $2}' /proc/meminfo) / 1024 - 512) / nodes ))
# Short-lived credentials: until they have expired, a requeued job waits.
cat > "$state/slurm.conf" <<CONF
ClusterName=here
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
AuthInfo=cred_expire=5
CryptoType=crypto/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
StateSaveLocation=$state/ctld
SlurmdSpoolDir=$state/%n
SlurmctldPidFile=$state/slurmctld.pid
SlurmdPidFile=$state/%n.pid
SlurmctldLogFile=$state/slurmctld.log
SlurmdLogFile=$state/slurm-%n.log
NodeName=n[1-$nodes] NodeHostname=$host NodeAddr=127.0.0.1 Port=[17001-$((17000 + nodes))] CPUs=$cores RealMemory=$memory State=UNKNOWN
PartitionName=here Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
export SLURM_CONF=$state/slurm.conf
started=()
stop() {
    status=$?
    if [ $status -ne 0 ]; then tail -n 20 "$state"/slurm*.log "$state"/*.out >&2 || true; fi
    kill "${started[@]}" 2>/dev/null || true
    wait 2>/dev/null || true
    rm -rf "$state"
    exit $status
}
trap stop EXIT
runuser -u munge -- /usr/sbin/munged --foreground >"$state/munged.out" 2>&1 & started+=($!)
for _ in $(seq 50); do munge -n >/dev/null 2>&1 && break; sleep 0.2; done
/usr/sbin/slurmctld -D >"$state/slurmctld.out" 2>&1 & started+=($!)
for node in $(seq "$nodes"); do
    mkdir "$state/n$node"
    /usr/sbin/slurmd -D -N "n$node" >"$state/n$node.out" 2>&1 & started+=($!)
done
for _ in $(seq 100); do
    [ "$(sinfo --noheader --format=%t 2>/dev/null)" = idle ] && break
    sleep 0.3
done
sinfo
"$@"
