import sys
src=open(__file__.replace('switches','policies_in_mdp')).read()
preset,num=sys.argv[1:3]; sys.argv=['diag',preset,num]
exec(src.split("keys=jax.random.split(jax.random.key(11)")[0])
keys=jax.random.split(jax.random.key(11),num)
@functools.partial(jax.jit,static_argnums=(1,))
def sw(keys,pol):
    def ep(key):
        sk,pk=jax.random.split(key)
        st=starts.reset(sk,mdp)
        def adv(c):
            st,i,done,k=c
            a=act(pol,jax.random.fold_in(pk,2*i),st,mdp)
            t0=st.team.target[st.agent]; on=(t0<N)
            g=gains(models,known(st,mdp))[st.agent]
            was_useful=jnp.append(g>0,False)[t0]
            switched=on&(a!=t0)
            toT=switched&(a<N)&jnp.append(st.team.is_taken(st.agent),False)[a]
            useless=(a<N)&~jnp.append(g>0,True)[a]
            st2,o=mdps.step(jax.random.fold_in(pk,2*i+1),mdp,st,a)
            both=jnp.sum(st2.team.heads&st2.team.works[:,None],0)
            k=k+jnp.stack([on,switched&was_useful,switched&~was_useful,toT,useless&~on,useless&on,o.poi<N,(o.seconds>0)*jnp.sum(jnp.maximum(both-1,0)),o.seconds>0,~(st.team.works.all())&True,(a==N)])
            return st2,i+1,o.terminated,k
        st2,i,_,k=jax.lax.while_loop(lambda c:~c[2]&(c[1]<300),adv,(st,jnp.int32(0),jnp.bool_(False),jnp.zeros(11)))
        return k,st2.seconds
    return jax.lax.map(ep,keys,batch_size=256)
for pol in ("auction","nearest","greedy_time","masked","latent"):
    k,s=sw(keys,pol); k=np.asarray(k).mean(0)
    print(preset,pol,"%.2f s | per episode: on-way choices %.1f, switches from useful %.1f, from useless %.1f, to taken %.1f; useless chosen first %.1f, on way %.1f; looks %.1f; shared %.2f"%(s.mean(),*k[:7],k[7]/k[8]),flush=True)
