#!/bin/bash
# One run as a task of a Slurm array: slurm_job.sh LIST COMMAND... appends line i of LIST, the run of task i, to COMMAND.
list=$1
shift
mapfile -t runs <"$list"
run=${runs[SLURM_ARRAY_TASK_ID]}
cd "$run" || exit 1

trainer='' interrupted='' ending='' requeue=''
end_trainer() {
    interrupted=1 ending=1
    [ -z "$trainer" ] || kill -TERM "$trainer" 2>/dev/null
}
trap end_trainer TERM              # cancelled, or preempted: then Slurm itself queues the task once more
trap 'requeue=1; end_trainer' USR1 # the time is nearly up: save, and queue the task once more

code=143 # of a task that is ended before its trainer begins
for _ in {1..20}; do
    [ -z "$ending" ] || break
    "$@" "$run" >>trainer.log 2>&1 &
    trainer=$!
    [ -z "$ending" ] || kill -TERM "$trainer" # the signal came before there was a trainer
    while # a signal ends the waiting, not the trainer
        interrupted=''
        wait "$trainer"
        code=$?
        [ -n "$interrupted" ] && [ "$code" -gt 128 ]
    do :; done
    trainer=''
    [ "$code" = 2 ] || break # 2: another trainer holds the run, perhaps on a node that only Slurm has lost
    sleep 15 &
    wait $!
done

if [ -n "$requeue" ] && [ "$code" != 1 ]; then                        # 1: the run has failed
    exec scontrol requeue "${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID" # SLURM_JOB_ID can be that of the whole array
fi
exit "$code"
