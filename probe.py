"""probe.py DATA SEQ FRAMES 0|1 [DATASET] [perturb]"""
import os, sys, time, json, numpy as np
from pathlib import Path
from dataclasses import replace
import cv2
from vslam.slam import Slam
from vslam.config import Config
from vslam.features import Extracted, TrackingState
from vslam.frontend.frame import Frame
from vslam.frontend.orb import build_pyramid
from vslam.frontend.extraction import extract_features
from vslam.frontend.patch_tracking import CoarseImages, track_patches
from vslam.frontend.tracker import Found, judge, result_of
from vslam.frontend.tracking import track_local_map
from vslam.machine import StageClock
from vslam.datasets import open_sequence
from vslam.geometry import *

class P(Slam):
    direct=True
    def step(self,left,right,ts):
        if not hasattr(self,'st'): self.st=dict(direct=0,due=0,fail=0,full=0); self.T={}; self.log=[]
        t0=time.perf_counter()
        def lap(n):
            nonlocal t0; t=time.perf_counter(); self.T[n]=self.T.get(n,0)+t-t0; t0=t
        mapper,tracker=self._mapper,self._tracker
        cfg,cam=self.context.config,self.context.camera
        frame=self._next_frame(Extracted.nothing(),ts,left)
        frame.pyramid=build_pyramid(left,cfg.orb)
        frame.coarse=CoarseImages.of(frame.pyramid)
        lap('pyramid')
        mapper.admit(frame,tracker.last,tracker.twist)
        lap('merge')
        hint=None; pred=None
        if self.direct and mapper.n_keyframes>3 and tracker.twist is not None and tracker.last is not None and tracker.lost_frames==0:
            pred=tracker.predict(ts,mapper.frames,mapper.view)
            m,n,visible=track_patches(frame,tracker.last,pred,mapper.view,self.context,self.st)
            lap('direct')
            if n:
                z=(frame.xyz@frame.T_cw[:3,:3].T+frame.T_cw[:3,3])[:,2]
                close=int((z<self.context.close_depth).sum())
                pol=self._mode.policy
                from vslam.frontend.keyframes import KeyframeEvidence
                if getattr(self,'base',None) is None: self.base=close
                pol._gain.add(close)
                ev=KeyframeEvidence(ts-mapper.last_timestamp,n,mapper.view.n_reference,close,10**6,mapper.is_merged,pol._gain.mean)
                rel=float(os.environ.get('REL','0'))
                want=pol.wants_keyframe(ev) or (close<rel*self.base and mapper.is_merged)
                if not want:
                    self.st['direct']+=1
                    found=Found(TrackingState.OK,m,n,visible)
                    tracker.accept(frame,found,mapper.frames)
                    placed=mapper.append_pose(frame,tracked=True,near=-1)
                    mapper.count(visible,frame.landmark.copy())
                    lap('rest')
                    return result_of(frame,found,False,{})
                self.st['due']+=1; hint=frame.T_cw
            else: self.st['fail']+=1; self.log.append(frame.index)
        self.st['full']+=1
        frame.extract(extract_features(left,right,self.context),cam)
        lap('extract')
        self.rig.prepare(frame,tracker.twist)
        if not mapper.n_keyframes:
            found=Found.at_start(frame,begun=self._mode.begin(mapper.append_pose(frame,tracked=False)))
            return result_of(frame,found,not found.is_lost,{})
        if pred is None: pred=tracker.predict(ts,mapper.frames,mapper.view)
        T=pred
        tracked=None
        if hint is not None:
            frame.T_cw=hint
            m,n,vis=track_local_map(frame,mapper.view.local_landmarks,self.context,patches=mapper.view.patches)
            st=judge(m,n,self.context)
            tracked=Found(st,m,n,vis,is_doubtful=tracker._is_doubtful(frame,n,mapper.view,mapper.frames))
            if tracked.is_lost: frame.landmark[:]=-1; frame.xyz[:]=np.nan
        if tracked is None or tracked.is_lost:
            tracked=tracker.track(frame,T,mapper.view,mapper.frames)
        if tracked.is_lost and self._mode.map_far_points():
            T=tracker.predict(ts,mapper.frames,mapper.view)
            tracked=tracker.track(frame,T,mapper.view,mapper.frames)
        lap('track')
        found=self._relocaliser.relocalise_if_needed(frame,tracked,mapper)
        if found.is_lost:
            frame.T_cw=T
            placed=mapper.append_pose(frame,tracked=False); tracker.lose()
            kf=self._mode.begin_after_loss(placed)
        else:
            tracker.accept(frame,found,mapper.frames)
            placed=mapper.append_pose(frame,tracked=True,near=found.keyframe)
            self.rig.observe(frame,frame.twist)
            pol=self._mode.policy
            if hint is not None and not found.relocalised:
                pol.wants_keyframe=lambda ev: True
            kf=self._mode.update_map(placed,found)
            pol.__dict__.pop('wants_keyframe',None)
            if kf: self.base=None
        lap('keyframe')
        return result_of(frame,found,kf,{})

data,seq,n,direct=sys.argv[1:5]; n=int(n); kind=sys.argv[5] if len(sys.argv)>5 else 'kitti'
s=open_sequence(kind,Path(data),seq if seq!='-' else None,max_frames=n or None)
cv2.setNumThreads(1)
import os
slam=P(s.camera,Config.model_validate(json.loads(os.environ.get('CFG','{}'))),'bow',threads=1); slam.direct=direct=='1'
lost=0; ts=s.timestamps.tolist(); read=0; est=[]
for i,t in enumerate(ts):
    if i==10: c0=time.process_time(); read=0; 
    a=time.perf_counter(); l,r=s.read(i); read+=time.perf_counter()-a
    if i==10: slam.T={}
    res=slam.step(l,r,t)
    if res.state==TrackingState.LOST: lost+=1; print('lost',i)
slam.finish()
cpu=time.process_time()-c0
tr=slam.trajectory()
P_=tr.T_wc[:,:3,3]; gt=s.ground_truth
G=np.asarray(gt.T_wc if hasattr(gt,'T_wc') else gt)[:len(P_),:3,3]
def umeyama(a,b):
    ma,mb=a.mean(0),b.mean(0); U,S,V=np.linalg.svd((b-mb).T@(a-ma)); D=np.diag([1,1,np.sign(np.linalg.det(U@V))]); R=U@D@V
    return np.sqrt((((a-ma)@R.T-(b-mb))**2).sum(1).mean())
Tg=np.asarray(gt.T_wc if hasattr(gt,'T_wc') else gt)[:len(P_)]
d=[]
for i in range(len(P_)-1):
    E=np.linalg.inv(np.linalg.inv(Tg[i])@Tg[i+1])@(np.linalg.inv(tr.T_wc[i])@tr.T_wc[i+1]); d.append(np.linalg.norm(E[:3,3]))
k=len(ts)-10
q=slam.st.pop('q',[0]); al=slam.st.pop('aligned',[0])
print(json.dumps(dict(seq=seq,mode=direct,frames=len(ts),lost=lost,ate=round(float(umeyama(P_,G)),4),rpe_cm=round(100*float(np.sqrt(np.mean(np.square(d)))),2),kf=len(slam.map.living_keyframes()),loops=len([e for e in slam.loops if e.accepted]),cpu_ms=round(1e3*cpu/k,2),read_ms=round(1e3*read/k,2),**slam.st,q=[round(float(x),2) for x in np.percentile(q,[1,10,50])],al=[round(float(x),2) for x in np.percentile(al,[1,10,50])],T={a:round(1e3*b/k,2) for a,b in slam.T.items()})))
print('fails',slam.log)
