import sys
src=open(__file__.replace('shared_pois','policies_in_mdp')).read()
preset,num=sys.argv[1:3]; sys.argv=['diag',preset,num]
exec(src.split("keys=jax.random.split(jax.random.key(11)")[0])
keys=jax.random.split(jax.random.key(11),num)
def mk(g0,f,early):
    def pol(key,models,k):
        g=gains(models,k)[k.robot]; t=k.times[k.robot]
        heads=k.team.heads&k.team.others(k.robot)[:,None]
        sooner=jnp.any(heads&(k.times<t[None]),0) if early else jnp.any(heads,0)
        w=jnp.where(sooner,f,1.)*g
        return jnp.append(jnp.where(g>0,jnp.log(jnp.maximum(w,1e-9))+t*np.log(g0)+1e3,-1.),0.)
    return pol
ref=np.asarray(run(keys,"auction")[0])
for g0 in (.2,.5,.7,.9):
    for f in (.001,.1,.3):
        for early in (True,False):
            ALL["x"]=mk(g0,f,early); run.clear_cache()
            sec,n,right,tot=map(np.asarray,run(keys,"x")); d=sec-ref
            print(preset,g0,f,early,"mean %.2f s (%.3f) (%+.2f +- %.2f) looks %.2f right %.4f total %.3f"%(sec.mean(),sec.mean()/ref.mean(),d.mean(),1.96*d.std()/len(d)**.5,n.mean(),right.mean(),tot.mean()),flush=True)
