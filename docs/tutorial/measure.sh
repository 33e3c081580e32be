# measure.sh PLAN DATA SEED [FORCE] stands for robot, weight and tracker: every pose without load and
# under FORCE (x y z in N, default a weight of 10 kg), three readings of each marker, by an arm with
# these compliances in rad/(N m).  With an arm of your own, DATA is what you bring instead.
elastocal simulate cell.toml "$1" -o "$2" --seed "$3" --load ${4:-0 0 -98} --repeats 3 \
    --set joint1.compliance=1.8e-6 --set joint2.compliance=2.1e-6 \
    --set joint3.compliance=3.4e-6 --set joint4.compliance=1.2e-5 \
    --set joint5.compliance=1.5e-5 --set joint6.compliance=2.2e-5
