import sys,numpy as np,jax,jax.numpy as jnp
from benchmarks import fast_model as F
from jaxsense import load_pretrained
from jaxsense.models import make_travel
from jaxsense.mission.state import *
preset=sys.argv[1]; n=int(sys.argv[2]); seed=int(sys.argv[3])
config,models=load_pretrained(preset); N=config.arena.num_pois
tr=make_travel(config); view=float(tr.view_distance); print("travel",tr)
rows=[]
for pol in sys.argv[4:]:
    st,rec=F.played(jax.random.key(seed),config,models,pol,n)
    pos=np.array(st.scene.layout.position); p0=np.array(st.scene.poses)
    for i in range(n):
        for r in range(rec.phase.shape[2]):
            sc=np.flatnonzero(rec.scanned[i,:,r]); s=-1
            for e in sc:
                # record at step e is after step; target during leg
                tg=rec.target[i,s+1:e,r] if s>=0 else rec.target[i,0:e,r]
                if s>=0: tg=rec.target[i,s+1:e,r]
                if len(tg)==0 or (tg!=tg[0]).any() or tg[0]>=N or tg[0]<0: s=e; continue
                t=tg[0]; start=rec.poses[i,s,r] if s>=0 else p0[i,r]
                d=pos[i,t]-start[:2]; dist=np.hypot(*d); turn=(np.arctan2(d[1],d[0])-start[2]+np.pi)%(2*np.pi)-np.pi
                straight=max(dist-view,0); dur=(e-s)*.1
                # other PoI near the straight segment
                u=d/dist; other=[j for j in range(N) if j!=t]
                def near(q):
                    a=(q-start[:2])@u; off=abs((q-start[:2])[0]*u[1]-(q-start[:2])[1]*u[0])
                    return off if 0<a<straight+.05 else 9
                pnear=min([near(pos[i,j]) for j in other])
                o=[x for x in range(rec.phase.shape[2]) if x!=r]
                seg=slice(max(s+1,0),e)
                same=max([np.mean(rec.target[i,seg,x]==t) for x in o])
                mind=min([np.min(np.linalg.norm(rec.poses[i,seg,x,:2]-rec.poses[i,seg,r,:2],axis=1)) for x in o])
                first=s<0
                final=np.linalg.norm(rec.poses[i,e,r,:2]-pos[i,t])
                rows.append((pol=="latent",first,dur,abs(turn),straight,pnear,same,mind,final,dist)); s=e
a=np.array(rows,float); print(len(a))
pol,first,dur,turn,straight,pnear,same,mind,final,dist=a.T
pred=float(tr.look_seconds)+turn/float(tr.turn_rate)+straight/float(tr.speed)
res=dur-pred
print("mean dur %.2f pred %.2f"%(dur.mean(),pred.mean()))
def show(name,m): print("%-28s n %5d dur %.2f residual mean %.2f median %.2f p90 %.2f"%(name,m.sum(),dur[m].mean(),res[m].mean(),np.median(res[m]),np.quantile(res[m],.9)))
for lab,m in (("all",dur>0),("straight=0",straight==0),("straight>0",straight>0),("poi in way <.25",pnear<.25),("poi .25-.4",(pnear>=.25)&(pnear<.4)),("clear",pnear>.4),("same target>.5",same>.5),("same <=.5",same<=.5),("mind<.3",mind<.3),("mind .3-.6",(mind>=.3)&(mind<.6)),("mind>.6",mind>=.6),("turn<.5",turn<.5),("turn .5-1.5",(turn>.5)&(turn<1.5)),("turn>1.5",turn>1.5),("clean",(pnear>.4)&(mind>.6)&(straight>0)),("clean same",(pnear>.4)&(mind>.6)&(same>.5)&(straight>0))): show(lab,m)
for lab,m in (("clean drive",(pnear>.4)&(mind>.6)&(straight>.1)),("clean stand",(straight==0)&(mind>.6))):
    X=np.stack([np.ones(m.sum()),turn[m],straight[m]],1); c,*_=np.linalg.lstsq(X,dur[m],rcond=None); print(lab,"fit const %.2f per rad %.2f per m %.2f rms %.2f"%(*c,np.std(dur[m]-X@c)))
print("final distance quantiles (driven)",np.quantile(final[straight>.1],[.05,.25,.5,.75,.95]).round(3))
for p in (0,1): print("policy latent" if p else "auction","legs",(pol==p).sum()/n,"sum res %.3f"%(res[pol==p].sum()/n),"same share %.2f"%(same[pol==p]>.5).mean(), "res same %.2f other %.2f"%(res[(pol==p)&(same>.5)].mean(),res[(pol==p)&(same<=.5)].mean()))
