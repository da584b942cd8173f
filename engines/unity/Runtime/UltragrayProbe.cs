using System;
using System.IO;
using UnityEngine;

namespace Ultragray.Unity
{
    public enum FramesFrom
    {
        Service,
        ThisMachine,
    }

    /// <summary>
    /// An ultrasound probe: fills a texture with what it sees at this transform. Its blue arrow points into the patient, its red one
    /// to the right of the image. A frame is asked for when the transform has moved; nothing waits for it, and a frame costs
    /// the main thread no garbage.
    /// </summary>
    [AddComponentMenu("UltraG-Ray/Probe")]
    public sealed class UltragrayProbe : MonoBehaviour
    {
        [Tooltip("Service: streamed, another machine renders. This Machine: rendered here by libultragray.")]
        public FramesFrom framesFrom = FramesFrom.Service;
        [Tooltip("Where frames, or the scene to render here, come from. Its key: the environment variable ULTRAGRAY_API_KEY, or Key.")]
        public string service = "http://localhost:8000";
        [Tooltip("Name of the scene at the service.")]
        public string scene = "demo";
        [Tooltip("For This Machine: a scene file in StreamingAssets; empty: the service's scene is downloaded.")]
        public string sceneFile = "";
        [Tooltip("The origin of the scene; empty: that of the world.")]
        public Transform patient;
        [Tooltip("Placed, turned and scaled to where the image is, below the probe: a Quad. May be empty.")]
        public Transform screen;
        [Tooltip("Side of a pixel in mm, for probes whose scan lines fan out; 0: a pixel for each sample of each scan line.")]
        public float pixelMm;

        const float Half = 0.70710678f; // sine and cosine of 45 degrees
        static readonly Quaternion Downwards = new Quaternion(-Half, 0f, 0f, Half); // a quad's up is the way to the probe
        IFrameSource source;
        RenderSettings settings;
        ProbePose asked;
        bool hasAsked;
        Frame frame;
        uint[] texels;

        /// <summary>The image, upright; null until the first frame has come. It is another one when its size changes.</summary>
        public Texture2D Image { get; private set; }

        /// <summary>The frame that the image shows: its header tells the pose, the settings, the confidence. Null at first.</summary>
        public Frame Frame => frame;

        /// <summary>What is wrong, in a sentence to show; null while frames come.</summary>
        public string Problem => source?.Problem;

        /// <summary>The key of the service, where it asks for one: set it before the component is enabled.</summary>
        public string Key { get; set; } = Environment.GetEnvironmentVariable("ULTRAGRAY_API_KEY");

        /// <summary>A new frame is in Image.</summary>
        public event Action<UltragrayProbe> Shown;

        /// <summary>Of frames from the next on, in 8 bit; set it anew to change them. Null: as the scene has them, and pixelMm.</summary>
        public RenderSettings Settings
        {
            get { return settings; }
            set
            {
                settings = value;
                if (source != null) source.Settings = Used();
            }
        }

        public void OnEnable()
        {
            hasAsked = false;
            var remote = new Service(service, Key);
            if (framesFrom == FramesFrom.Service) source = remote.Stream(scene, Used(), "Unity " + name);
            else source = new LocalFrames(Reading(remote), Used());
        }

        public void OnDisable()
        {
            source?.Dispose();
            source = null;
        }

        public void OnDestroy()
        {
            if (Image != null) Destroy(Image);
        }

        public void Update()
        {
            var pose = PoseOf(transform, patient);
            if (!hasAsked || !pose.Equals(asked)) source.Ask(pose);
            hasAsked = true;
            asked = pose;
            if (!source.Take(ref frame)) return;
            Show();
            if (screen != null) Place(frame.Header.Picture);
            Shown?.Invoke(this);
        }

        /// <summary>The pose of a probe in the scene whose origin is at `patient`; null: at that of the world.</summary>
        public static ProbePose PoseOf(Transform probe, Transform patient)
        {
            var p = patient == null ? probe.position : patient.InverseTransformPoint(probe.position);
            var q = patient == null ? probe.rotation : Quaternion.Inverse(patient.rotation) * probe.rotation;
            return ProbePose.FromUnity(p.x, p.y, p.z, q.x, q.y, q.z, q.w);
        }

        RenderSettings Used()
        {
            var used = settings ?? new RenderSettings();
            if (settings == null && pixelMm > 0f) used.Display = new DisplaySettings { PixelMm = pixelMm };
            used.Encoding = PixelEncoding.Uint8;
            return used;
        }

        Func<Stream> Reading(Service remote)
        {
            string path = Path.Combine(Application.streamingAssetsPath, sceneFile), name = scene;
            if (sceneFile != "") return () => File.OpenRead(path);
            return () => remote.Download(name).GetAwaiter().GetResult(); // on the thread that loads
        }

        /// <summary>Copies the first output: Unity's first row is the lowest one, and grey has three channels there.</summary>
        void Show()
        {
            int height = frame.Height, width = frame.Width;
            if (Image == null || Image.height != height || Image.width != width)
            {
                if (Image != null) Destroy(Image);
                Image = new Texture2D(width, height, TextureFormat.RGBA32, false) { name = "UltraG-Ray" };
                texels = new uint[height * width];
            }
            var pixels = frame.Pixels(frame.Header.Outputs[0]);
            byte[] grey = pixels.Array;
            for (int row = 0; row < height; row++)
            {
                int from = pixels.Offset + row * width, to = (height - 1 - row) * width;
                for (int column = 0; column < width; column++) texels[to + column] = 0xFF000000u | grey[from + column] * 0x010101u;
            }
            Image.SetPixelData(texels, 0);
            Image.Apply(false);
        }

        /// <summary>Puts the screen where the pixels lie. Angular scan lines that were not converted have no such place.</summary>
        void Place(Picture picture)
        {
            if (picture.ColumnUnit != "mm") return;
            double column = picture.First[0] + picture.Step[0] * (picture.Width - 1) / 2;
            double row = picture.First[1] + picture.Step[1] * (picture.Height - 1) / 2;
            screen.rotation = transform.rotation * Downwards;
            screen.position = transform.position + transform.rotation * new Vector3((float)column / 1000f, 0f, (float)row / 1000f);
            screen.localScale = new Vector3((float)(picture.Step[0] * picture.Width) / 1000f, (float)(picture.Step[1] * picture.Height) / 1000f, 1f);
        }
    }
}
