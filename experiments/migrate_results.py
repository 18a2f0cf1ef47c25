"""Convert the committed results to schema 3: partitions, validation steps, curves by algorithm."""
import hashlib, json
from pathlib import Path
import numpy as np
from uavmec_jax.files.writing import write_arrays, write_text
NAMES={'count':'shards','size':'shard_size','groups':'groups','devices':'groups','bytes':'shard_bytes'}
def partition(cut): return {NAMES[k]:v for k,v in cut.items()}
for path in sorted(Path('results').rglob('run.json')):
    run=json.loads(path.read_text()); folder=path.parent
    if run['schema']==3: continue
    old=run['schema']
    out={}
    algorithm='none' if not (folder/'curves.npz').exists() else 'dqn'
    for k,v in run.items():
        if k=='schema': v=3
        elif k=='blocks':
            k='partitions'
            v={algorithm: partition(v)} if isinstance(v,dict) and 'count' in v else {n: partition(c) for n,c in v.items()}
        elif k=='snapshot_share': k='checkpoint_share'
        elif k=='seconds': v={('checkpoint' if n=='snapshot' else n):s for n,s in v.items()}
        out[k]=v
    curves=folder/'curves.npz'
    if curves.exists():
        with np.load(curves) as z: arrays={n:z[n] for n in z.files}
        if old==1: arrays={f'dqn/{n}':a for n,a in arrays.items()}
        arrays={n.replace('look_steps','validation_steps'):a for n,a in arrays.items()}
        write_arrays(curves, arrays)
    if 'sha256' in out:
        out['sha256']={n: hashlib.sha256((folder/n).read_bytes()).hexdigest() if (folder/n).exists() else d for n,d in out['sha256'].items()}
    write_text(path, json.dumps(out,indent=1)+'\n')
    print(path, old, '->', 3, out.get('partitions'))
