import sys,dataclasses,functools,time,numpy as np,jax,jax.numpy as jnp
from jaxsense import load_pretrained, mission
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.mission.rollout import rollout_batch
from jaxsense.mission.state import no_faults
preset,n,sec,seed=sys.argv[1],int(sys.argv[2]),float(sys.argv[3]),int(sys.argv[4])
config,models=load_pretrained(preset); made=mission.make_mission(config); steps=round(sec/CONTROL_PERIOD)
ref=None
@functools.partial(jax.jit,static_argnums=(1,))
def play(key,pol):
    rk,pk=jax.random.split(key)
    faults,index=no_faults(config),made.policy(pol)
    st=jax.vmap(lambda k: mission.reset(k,made,models,index,faults))(jax.random.split(rk,n))
    def chunk(st,key):
        st,rec=rollout_batch(jax.random.split(key,n),made,models,st,5)
        b=jax.tree.map(lambda x:x[:,-1],rec.belief)
        p=jax.vmap(jax.vmap(models.fusion.class_probabilities))(b)
        H=-jnp.sum(jnp.where(p>0,p*jnp.log(jnp.maximum(p,1e-12)),0.),-1)
        return st,(jnp.mean(H,-1),st.done)
    st,(H,done)=jax.lax.scan(chunk,st,jax.random.split(pk,steps//5))
    return H.T,done.T
H0=np.log(len(config.arena.classes))
for pol in sys.argv[5:]:
    t=time.time(); H,done=map(np.asarray,play(jax.random.key(seed),pol))
    t_end=(~done).sum(1)*.5; ts=.5*np.arange(1,H.shape[1]+1)
    m=H.mean(0)
    first=lambda q: np.argmax(np.c_[H<=H0*(1-q),np.ones(len(H))],1)*.5+.25
    area=(H.sum(1)+H0)*.5-.25*H0   # nat s per PoI until the horizon
    if ref is None: ref=(area,first(.5),first(.9),t_end)
    d=[x-y for x,y in zip((area,first(.5),first(.9),t_end),ref)]
    f=lambda x,dd:"%.2f (%+.2f+-%.2f)"%(x.mean(),dd.mean(),1.96*dd.std()/n**.5)
    print(preset,pol,"nat s",f(area,d[0]),"| 50%",f(first(.5),d[1]),"| 90%",f(first(.9),d[2]),"| end",f(t_end,d[3]),"| last H %.4f, (%.0f s)"%(m[-1],time.time()-t),flush=True)
