run() { echo "REL=$REL CFG=$CFG"; for a in "/work/shared/data/kitti 00 216" "/work/shared/data/kitti 06 0" "/work/h/m41/towns/v2-seed0 kitti07 600" "/work/h/m41/towns/v2-seed0 kitti06 500"; do .venv/bin/python probe.py $a ${M:-1} | grep ate | cut -c1-230; done; }
export CFG='{}'
REL=0.6 run; REL=0.7 run; REL=0.8 run
REL=0 CFG={} run
