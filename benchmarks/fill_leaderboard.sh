#!/usr/bin/env bash
# The entries of benchmarks/leaderboard: run, verified, and their rows written.
#
#     benchmarks/fill_leaderboard.sh FOLDER [QUERIES]
#     python benchmarks/render_tables.py
#
# What is in FOLDER already is left as it is, so an interrupted run continues. 200 queries of every
# entry take about an hour on one core. Needs roboplan and stable-baselines3.
set -euo pipefail
queries=${2:-200}
root=$(realpath "$(dirname "$0")/..")
rows=$root/benchmarks/leaderboard
export PYTHONPATH=$root/examples/benchmark:${PYTHONPATH-}
mkdir -p "$1"
cd "$1"

entry() { # FILE, tasks, method, flags of `roboarm benchmark run`
  local name=$1 tasks=$2 method=$3
  shift 3
  if [ -e "$name/verified" ]; then return; fi
  # shellcheck disable=SC2086
  roboarm benchmark run --output "$name" --name "$method" --tasks $tasks \
    --num-queries "$queries" --workers 1 "$@"
  roboarm benchmark verify "$name" --row "$rows/$name.yaml"
  touch "$name/verified"
}
walls=double_walls
hard=random_boxes_hard
both="$hard $walls"
ours() { entry "$@" --authors RoboArm-NMP --licence MIT --developed-on $walls $hard; }
example() { entry "$@" --authors "RoboArm-NMP (example)" --licence MIT; }
ompl() { entry "$@" --searches --observes ground_truth --authors OMPL --licence BSD-3-Clause; }

cloud="--observes point_cloud"
demos="demonstrations of"
roadmaps="roadmaps in scenes of random_boxes_hard"
families="roadmaps in wide_scenes and random_boxes_hard"
flow="--policy flow-combined-point_cloud-wide_scenes-s1"
roadmap_bc="--policy roadmap-bc-combined-point_cloud-random_boxes_hard-s1"

ours go_to_goal "$both" "go-to-goal" --policy go-to-goal
ours go_to_goal_filter "$both" "go-to-goal, safety filter" --policy go-to-goal \
  --safety-margin 0.01 $cloud
ours rrt_connect "$both" "RRT-Connect, compiled" --policy planner
ours rrt_connect_point_cloud "$both" "RRT-Connect, compiled" --policy planner $cloud
ours via_points "$both" "via-points" --policy via-points
ours replanning "$both" "replanning" --policy replanning $cloud
ours flow "$both" "flow" $flow --training-data "$families"
ours flow_search "$both" "flow, else search" $flow --search --training-data "$families"
ours roadmap_bc "$both" "roadmap BC" $roadmap_bc --training-data "$roadmaps"
ours sac $walls "SAC with demonstrations" --policy sac-ee-double_walls-p1-s1 \
  --training-data "1,000,000 steps, $demos $walls"
ours td3 $walls "TD3 with demonstrations" --policy td3-ee-double_walls-p1-s1 \
  --training-data "1,000,000 steps, $demos $walls"
ours bc $walls "BC" --policy bc-combined-double_walls-s1 --training-data "$demos $walls"
ours bc_vae $hard "BC, VAE" --policy bc-combined-vae-random_boxes_hard-s1 \
  --training-data "$demos $hard"
ours bc_oracle $hard "BC, obstacles as input" --policy bc-combined-oracle-random_boxes_hard-s1 \
  --training-data "$demos $hard"

ours pose_go_to_goal $hard "go-to-goal" --policy go-to-goal --pose-goals
ours pose_rrt_connect $hard "RRT-Connect, compiled" --policy planner --pose-goals
ours pose_rrt_connect_point_cloud $hard "RRT-Connect, compiled" --policy planner $cloud --pose-goals
ours pose_flow $hard "flow" $flow --pose-goals --training-data "$families"
ours pose_roadmap_bc $hard "roadmap BC" $roadmap_bc --pose-goals --training-data "$roadmaps"

ompl ompl_rrt_connect "$both" "OMPL RRT-Connect" --function ompl_planners:rrt_connect \
  --link https://ompl.kavrakilab.org
ompl bit_star "$both" "OMPL BIT*, 1 s" --function ompl_planners:bit_star \
  --link https://arxiv.org/abs/1405.5848
ompl rrt_star "$both" "OMPL RRT*, 1 s" --function ompl_planners:rrt_star \
  --link https://arxiv.org/abs/1105.1186
entry roboplan_rrt_star "$both" "roboplan RRT*" --function roboplan_rrt_star:begin --searches \
  --observes ground_truth --authors roboplan --licence MIT --link https://pypi.org/project/roboplan
example trajectory_optimisation "$both" "optimised path, as by CHOMP" --searches \
  --function trajectory_optimisation:begin --observes ground_truth \
  --link https://doi.org/10.1177/0278364913488805
example potential_field "$both" "potential field" --function potential_field:begin $cloud \
  --link https://doi.org/10.1177/027836498600500106
if [ ! -e sac_her.zip ]; then
  python "$root/examples/benchmark/stable_baselines3_sac_her.py" $walls 100000
fi
example stable_baselines3_sac_her $walls "SAC and HER, Stable-Baselines3" \
  --function stable_baselines3_sac_her:begin --training-data "100,000 steps of $walls" \
  --link https://stable-baselines3.readthedocs.io
