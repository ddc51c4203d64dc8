"""Make the shipped models: `python -m model_export.ship`."""
import hashlib, json, sys
from pathlib import Path
import torch, onnx
from model_export.network import SpectralSolver
STEPS={"fast":[("chain",1.0)],"balanced":[("chain",1.0),("front",.9),("rear",.9)],"best":[("chain",1.0),("front",.9),("rear",.9),("chain",1.0)]+[("front",.9),("rear",.9)]*4}
def main():
    for name,steps in STEPS.items():
        torch.manual_seed(0)
        net=SpectralSolver().eval()
        K,n,rows=4,8,6
        args=(torch.zeros(rows,n,2*K*3),torch.zeros(n+1,n),torch.ones(n),torch.zeros(n,n),torch.ones(1))
        path=Path(__file__).parents[1]/"runtime/model/data"/f"{name}.onnx"
        torch.onnx.export(net,args,str(path),opset_version=17,input_names=["difference","modes_out","spectrum","modes_in","tolerance_mm"],output_names=["front"],
          dynamic_axes={"difference":{0:"rows",1:"cells",2:"columns"},"modes_out":{0:"cells1",1:"cells"},"spectrum":{0:"cells"},"modes_in":{0:"cells",1:"cells"},"front":{0:"rows",1:"cells1",2:"columns"}},dynamo=False)
        m=onnx.load(str(path))
        c=dict(version=1,arch="spectral",name=name,panels=3,eyes=2,input_frame="chain",input_value="phase",layout="RNC",eye_order="left-right",output="outer",branch=2,value_range=[0,1],
          trained_for=dict(distance_m=[.1,4],off_axis_deg=[0,70],separation_m=[.015,.07],spacing_m=[.005,.5]),recipe_sha256=hashlib.sha256(b"").hexdigest(),parameters=sum(p.numel() for p in net.parameters()),cell_px=K,reduction=2,steps=[dict(kind=k,size=s) for k,s in steps])
        e=m.metadata_props.add(); e.key="phasestack.contract"; e.value=json.dumps(c)
        onnx.save(m,str(path)); print(path,path.stat().st_size)
main()
