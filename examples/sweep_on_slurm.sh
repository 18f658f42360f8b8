#!/bin/bash
# A sweep on Slurm: one Ray node per Slurm node (docs/cluster.md). Change paths, times and sizes, then submit it by sbatch.
# --signal: Ctrl-C for the sweep three minutes before the end, so that it saves checkpoints and writes tables;
# trainings take up to two, and Slurm may send it a minute early
#SBATCH --nodes=4 --ntasks-per-node=1 --gpus-per-node=8 --cpus-per-task=32 --time=12:00:00
#SBATCH --signal=B:INT@180
HEAD=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
CPUS=$SLURM_CPUS_PER_TASK  # since Slurm 22.05, srun does not inherit it from sbatch
MPS="nvidia-cuda-mps-control -d"  # for --per-gpu; MPS ends when its srun step ends, so start it inside each step
srun --nodes=1 --ntasks=1 --cpus-per-task="$CPUS" -w "$HEAD" --overlap \
  bash -c "$MPS; ray start --head --port 6379 --num-cpus $CPUS --block" &
sleep 20
if [ "$SLURM_NNODES" -gt 1 ]; then
  srun --nodes=$((SLURM_NNODES - 1)) --ntasks=$((SLURM_NNODES - 1)) --cpus-per-task="$CPUS" -x "$HEAD" \
    bash -c "$MPS; ray start --address $HEAD:6379 --num-cpus $CPUS --block" &
  sleep 20
fi
# exec: the signal reaches only the process of this script, so the sweep takes its place
exec warpgs sweep ablation --data /shared/nerfds --out /shared/ablation --per-gpu 2 --address "$HEAD:6379"
