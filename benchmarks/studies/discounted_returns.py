import sys
src=open(__file__.replace('discounted_returns','policies_in_mdp')).read()
preset,num=sys.argv[1:3]; sys.argv=['diag',preset,num]
exec(src.split("keys=jax.random.split(jax.random.key(11)")[0])
keys=jax.random.split(jax.random.key(11),num)
mdp=dataclasses.replace(mdp,teams=dataclasses.replace(mdp.teams,partly_seen=.7))
@functools.partial(jax.jit,static_argnums=(1,))
def sw(keys,pol):
    def ep(key):
        sk,pk=jax.random.split(key)
        st=starts.reset(sk,mdp)
        def adv(c):
            st,i,done,k=c
            a=act(pol,jax.random.fold_in(pk,2*i),st,mdp)
            st2,o=mdps.step(jax.random.fold_in(pk,2*i+1),mdp,st,a)
            k=k+jnp.stack([o.reward*g**st2.seconds for g in (.2,.5,.8,.95)])
            return st2,i+1,o.terminated,k
        st2,i,_,k=jax.lax.while_loop(lambda c:~c[2]&(c[1]<300),adv,(st,jnp.int32(0),jnp.bool_(False),jnp.zeros(4)))
        return k,st2.seconds
    return jax.lax.map(ep,keys,batch_size=256)
ref=None
for pol in ("auction","nearest","greedy_time","gt5","masked","latent"):
    k,s=sw(keys,pol); k=np.asarray(k)
    if ref is None: ref=k
    d=k-ref
    print(preset,pol,"%.2f s"%s.mean()," ".join("%.3f (%+.3f+-%.3f)"%(a,b,c) for a,b,c in zip(k.mean(0),d.mean(0),1.96*d.std(0)/len(d)**.5)),flush=True)
