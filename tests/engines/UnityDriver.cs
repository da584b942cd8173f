// Runs the component as Unity does. By lines: `probe X Y Z` and `patient X Y Z` (metres), `turn QX QY QZ QW` of the probe, `size HEIGHT WIDTH`,
// `disable`, `enable`, `updates N`, `until N` frames were shown in all, `problem`: until there is one, `garbage`. Each is told when it is done.

using System;
using System.Globalization;
using System.Linq;
using System.Threading;
using Ultragray;
using Ultragray.Unity;
using UnityEngine;

static class UnityDriver
{
    static void Main(string[] words)
    {
        CultureInfo.CurrentCulture = CultureInfo.InvariantCulture;
        var probe = new UltragrayProbe { service = words[1], name = "probe", patient = new Transform(), screen = new Transform() };
        if (words[0] == "local") probe.framesFrom = FramesFrom.ThisMachine;
        if (words.Length > 2) probe.sceneFile = words[2];
        int shown = 0;
        probe.Shown += which => shown++;
        probe.OnEnable();
        string line;
        while ((line = Console.In.ReadLine()) != null)
        {
            var said = line.Split(' ');
            var numbers = said.Skip(1).Where(one => one.Length > 0).Select(float.Parse).ToArray();
            if (said[0] == "probe") probe.transform.position = new Vector3(numbers[0], numbers[1], numbers[2]);
            else if (said[0] == "patient") probe.patient.position = new Vector3(numbers[0], numbers[1], numbers[2]);
            else if (said[0] == "turn") probe.transform.rotation = new Quaternion(numbers[0], numbers[1], numbers[2], numbers[3]);
            else if (said[0] == "size") probe.Settings = new RenderSettings { Height = (long)numbers[0], Width = (long)numbers[1] };
            else if (said[0] == "disable") probe.OnDisable();
            else if (said[0] == "enable") probe.OnEnable();
            else if (said[0] == "until") Until(probe, () => shown >= numbers[0]);
            else if (said[0] == "updates") for (int i = 0; i < numbers[0]; i++) probe.Update();
            else if (said[0] == "problem") Until(probe, () => probe.Problem != null);
            else if (said[0] == "garbage") Garbage(probe, () => shown);
            Console.WriteLine("did " + line);
        }
        probe.OnDisable();
        probe.OnDestroy();
        Console.WriteLine("destroyed " + probe.Image.isDestroyed);
    }

    static void Until(UltragrayProbe probe, Func<bool> isReached)
    {
        while (!isReached())
        {
            probe.Update();
            Thread.Sleep(1);
        }
        if (probe.Problem != null) Console.WriteLine("problem " + probe.Problem);
        if (probe.Image == null) return;
        var image = probe.Image;
        Console.WriteLine("image " + image.width + " " + image.height + " " + string.Join(" ", image.shown.Select(texel => texel.ToString("x8"))));
        Console.WriteLine("pose " + string.Join(" ", probe.Frame.Header.Pose.SelectMany(row => row).Select(one => one.ToString("R"))));
        var screen = probe.screen;
        var corner = screen.position + screen.rotation * new Vector3(-screen.localScale.x / 2, screen.localScale.y / 2, 0);
        Console.WriteLine("corner " + corner.x + " " + corner.y + " " + corner.z);
    }

    /// What the thread of the game leaves as garbage while a hundred frames are shown.
    static void Garbage(UltragrayProbe probe, Func<int> shown)
    {
        long before = GC.GetAllocatedBytesForCurrentThread();
        for (int last = shown() + 100; shown() < last;)
        {
            probe.transform.position.x += 1e-5f;
            probe.Update();
            Thread.Sleep(1);
        }
        Console.WriteLine("garbage " + (GC.GetAllocatedBytesForCurrentThread() - before));
    }
}
