using Ultragray;
using Ultragray.Unity;
using UnityEngine;

/// <summary>A probe that the arrow keys move and turn, and its image where it is in the patient. Put it on an empty GameObject, and press Play.</summary>
public sealed class FirstProbe : MonoBehaviour
{
    const float MetresPerSecond = 0.02f, DegreesPerSecond = 30f;
    UltragrayProbe probe;

    void Start()
    {
        var screen = GameObject.CreatePrimitive(PrimitiveType.Quad).GetComponent<Renderer>();
        screen.material = new Material(Shader.Find("Unlit/Texture"));
        var body = GameObject.CreatePrimitive(PrimitiveType.Cube);
        body.transform.localScale = new Vector3(0.06f, 0.02f, 0.002f);
        probe = body.AddComponent<UltragrayProbe>();
        probe.screen = screen.transform;
        probe.Settings = new RenderSettings { Display = new DisplaySettings { GainDb = 3 } };
        probe.Shown += shown => screen.material.mainTexture = shown.Image;
    }

    void Update()
    {
        var body = probe.transform;
        body.position += body.rotation * new Vector3(0, Input.GetAxis("Vertical") * MetresPerSecond * Time.deltaTime, 0);
        body.rotation *= Quaternion.Euler(Input.GetAxis("Horizontal") * DegreesPerSecond * Time.deltaTime, 0, 0);
    }

    void OnGUI()
    {
        double? confidence = probe.Frame?.Confidence;
        GUI.Label(new Rect(10, 10, 900, 40), probe.Problem ?? (confidence == null ? "" : "expected similarity " + confidence.Value.ToString("P0")));
    }
}
