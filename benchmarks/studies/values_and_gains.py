import sys
exec(open('benchmarks/studies/policies_in_mdp.py').read().split("@functools.partial(jax.jit,static_argnums=(1,))")[0].replace("sys.argv[2]","'256'").replace("pols=sys.argv[3:]","pols=[]"))
num=256
import pickle,os,variants,jaxsense.dqn.agent as AG
if os.environ.get('NET'):
    AG.PoolingNetwork=variants.make(os.environ['NET'])
    pk=pickle.load(open(os.environ['PK'],'rb'))
    from jaxsense.models import make_agent
    c1=dataclasses.replace(config,dqn=dataclasses.replace(config.dqn,discount=float(os.environ['DISC'])))
    models=dataclasses.replace(models,q_networks=(pk,),agent=make_agent(c1))
def ep(key):
    sk,pk=jax.random.split(key)
    st=starts.reset(sk,mdp)
    def adv(c,i):
        st,done=c
        k=known(st,mdp); q,v=q_of(models,k); g=gains(models,k)[k.robot]
        a=P.best(jnp.where(st.team.action_mask,v,-jnp.inf))
        st2,o=mdps.step(jax.random.fold_in(pk,2*i+1),mdp,st,a)
        aa=jnp.minimum(a,N-1)
        row=dict(a=a,q=q[aa],g=g[aa],t=k.times[k.robot][aa],gmax=g.max(),nuse=(g>0).sum(),valid=~done,sec=st.seconds,poi=o.poi,r=o.reward,robot=k.robot,taken=k.team.is_taken(k.robot)[aa],qall=q[:-1],gall=g,tall=k.times[k.robot])
        st2=jax.tree.map(lambda x,y: jnp.where(done,x,y),st,st2)
        return (st2,done|o.terminated),row
    return jax.lax.scan(adv,(st,jnp.bool_(False)),jnp.arange(160))[1]
keys=jax.random.split(jax.random.key(12),num)
r=jax.tree.map(np.asarray,jax.jit(jax.vmap(ep))(keys))
m=r['valid']; f={k:v[m] for k,v in r.items()}
look=f['a']<N
print("decisions/episode",m.sum()/num,"NOP",(~look).sum()/num)
print("chosen looks: useful (g>0) share",(f['g'][look]>0).mean())
bad=look&(f['g']<=0)
print("chosen useless: q quantiles",np.quantile(f['q'][bad],[.05,.25,.5,.75,.95]).round(4),"g",np.quantile(f['g'][bad],[.05,.25,.5,.75,.95]).round(4),"t",np.quantile(f['t'][bad],[.05,.25,.5,.75,.95]).round(2))
none=bad&(f['nuse']==0); print("of these: nothing useful left for this robot",none.sum()/num,"some useful",(bad&(f['nuse']>0)).sum()/num)
# nothing useful & NOP chosen
nn=(f['nuse']==0); print("states w/o useful",nn.sum()/num,"NOP there",(nn&~look).sum()/num); print("states with useful but NOP",((f['nuse']>0)&~look).sum()/num, "gmax there",np.quantile(f['gmax'][(f['nuse']>0)&~look],[.1,.5,.9]) if ((f['nuse']>0)&~look).any() else None)
qa=f['qall'].ravel(); ga=f['gall'].ravel(); ta=f['tall'].ravel()
for lo,hi in ((-.05,-.018),(-.018,-.01),(-.01,0),(0,.01),(.01,.03),(.03,.1),(.1,.3),(.3,2)):
    s=(ga>lo)&(ga<=hi)
    if s.any(): print("g in (%.3f,%.3f] n %d q mean %.4f sd %.4f share q>0 %.3f"%(lo,hi,s.sum(),qa[s].mean(),qa[s].std(),(qa[s]>0).mean()))
print("look cost",config.mdp.look_cost)
