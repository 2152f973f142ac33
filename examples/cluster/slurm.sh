#!/usr/bin/env bash
# Runs a command on a Ray cluster that is made of the nodes of this SLURM job and ends with it:
#
#     sbatch examples/cluster/slurm.sh tint-sumo study run --budget full --executor ray --address auto --out runs/full
#
# All nodes need the same environment with tint_sumo[ray], for instance on a disk that they share; activate it before
# you call sbatch. Change the lines below to what your cluster offers, or give sbatch the same options.
#SBATCH --job-name=tint-sumo
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=8
#SBATCH --mem-per-cpu=1500M
#SBATCH --time=04:00:00
#SBATCH --no-kill
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:USR1@120
set -euo pipefail

if [ "$#" -eq 0 ]; then
    echo "Say what to run: sbatch $0 tint-sumo study run --executor ray --address auto --out runs/full" >&2
    exit 2
fi

# This script runs on the first node. Where nodes have several networks, put the address of the private one here.
address=$(hostname -I | cut -d ' ' -f 1)
port=$((20000 + SLURM_JOB_ID % 10000 * 3)) # two jobs may share a node

# Ray listens on all networks of a node, and runs whatever reaches it. Hence it takes orders only from those who know
# the token, which is in a file that only you can read.
export RAY_AUTH_MODE=token RAY_USAGE_STATS_ENABLED=0
RAY_AUTH_TOKEN=$(umask 077 && ray get-auth-token --generate 2>/dev/null)
export RAY_AUTH_TOKEN

start_ray() { # NODES OPTION...: one Ray process tree on each node, for as long as srun runs
    srun --nodes="$1" --ntasks="$1" --cpus-per-task="$SLURM_CPUS_PER_TASK" --no-kill --kill-on-bad-exit=0 "${@:2}" \
        --num-cpus="$SLURM_CPUS_PER_TASK" --min-worker-port=0 --max-worker-port=0 &
}

end_ray() { # ends what this script has started and nothing else: other jobs may have a Ray on the same node
    jobs -p | xargs --no-run-if-empty kill -TERM 2>/dev/null || true
    wait
}
trap end_ray EXIT

start_ray 1 --nodelist="$SLURMD_NODENAME" ray start --head --block --node-ip-address="$address" --port="$port" \
    --ray-client-server-port=$((port + 1)) --dashboard-host=127.0.0.1 --dashboard-port=$((port + 2)) \
    --temp-dir="/tmp/ray-$SLURM_JOB_ID"
head=$!
until (: <"/dev/tcp/$address/$port") 2>/dev/null && ray health-check --address "$address:$port" >/dev/null 2>&1; do
    kill -0 "$head" 2>/dev/null || { echo "Ray did not start on $SLURMD_NODENAME" >&2; exit 1; }
    sleep 1
done
if [ "$SLURM_JOB_NUM_NODES" -gt 1 ]; then
    start_ray $((SLURM_JOB_NUM_NODES - 1)) --exclude="$SLURMD_NODENAME" ray start --block --address="$address:$port"
fi
echo "Dashboard: ssh -L 8265:127.0.0.1:$((port + 2)) $SLURMD_NODENAME, then http://localhost:8265"

export RAY_ADDRESS=$address:$port # this is what --address auto finds
# SLURM sends USR1 two minutes before the time is over. The job then goes to the end of the queue, and the same command
# goes on there with what is in its --out. $! is the command, from the moment it has begun.
requeue=false
trap 'requeue=true; kill -TERM $! || true' USR1
trap 'kill -TERM $! || true' TERM
"$@" &
command=$!
while kill -0 "$command" 2>/dev/null; do
    wait "$command" || true # a signal ends this, too
done
status=0
wait "$command" || status=$?
if [ "$requeue" = true ]; then
    end_ray
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$status"
